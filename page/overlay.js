// The bar above the page: STOP, what became of it, and what is lost. It has a connection of its own (line.py), which
// nothing else waits in. Buttons anywhere on the page speak over it too: those with data-press are clicked; those with
// data-hold say so again and again while they are held down, and nothing once they are not.
(() => {
  const AGAIN = 40;  // [ms] between two words that a button is still held
  const SILENT = 1500;  // [ms] without a word from the page's server, after which it is lost; it speaks each 250 ms
  const FIRST = 6000;  // [ms] in which there may be none yet
  const ANSWER = 3000;  // [ms] for what became of STOP
  const STUCK = 2000;  // [bytes] that wait to be sent: what is held does not get there

  let socket = null, heard = null, page = "", asked = 0, waiting = new Map(), told = 0, held = null, presses = 0, seen = 0;
  const opened = Date.now();
  const bar = document.createElement("div");
  bar.id = "zc-bar";
  bar.innerHTML = `<div id="zc-row"><button id="zc-stop" type="button" title="Stop the arm and the task (Escape)"
      aria-label="STOP: stop the arm and the task" aria-keyshortcuts="Escape">STOP</button>
    <div id="zc-said"><div id="zc-how"></div><div id="zc-note" role="status" aria-live="assertive"></div></div></div>
    <div id="zc-past" role="status"></div><div id="zc-lost" role="alert"></div>`;
  const part = id => bar.querySelector(`#zc-${id}`);
  const time = when => new Date(when).toLocaleTimeString([], {hour12: false});

  function say(line, kind) {
    part("note").textContent = line ? `${time(Date.now())} ${line}` : "";
    part("note").className = kind || "";
  }

  // --- the connection ---

  const open = () => socket !== null && socket.readyState === WebSocket.OPEN;
  const lostSince = () => heard === null ? (Date.now() - opened > FIRST ? opened : null)
    : Date.now() - heard > SILENT ? heard : null;

  function connect() {
    const mine = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/line`);
    socket = mine;
    mine.onopen = () => { if (page) send({do: "page", what: page}); };
    mine.onmessage = message => { if (mine === socket) take(JSON.parse(message.data)); };
    mine.onclose = () => { if (mine === socket) { letGo(); setTimeout(connect, 700); } };
  }

  function send(words) {
    if (!open()) return false;
    socket.send(JSON.stringify(words));
    return true;
  }

  function take(words) {
    heard = Date.now();
    if (words.news) { seen = words.news.time; show(words.news); }
    if (words.said !== undefined) {
      clearTimeout(waiting.get(words.n));
      waiting.delete(words.n);
      if (words.kind === "bad" && words.n === 0) letGo();
      say(words.said, words.kind);
    }
  }

  function show(news) {
    const how = news.how.map(([word, kind]) => {
      const span = document.createElement("span");
      span.textContent = word;
      span.className = kind;
      return span;
    });
    const shown = how.map(span => span.outerHTML).join(" · ");
    if (part("how").dataset.shown !== shown) { part("how").innerHTML = shown; part("how").dataset.shown = shown; }
    if (news.note.number > told) {
      if (told || news.note.line) say(news.note.line, news.note.kind);
      told = news.note.number;
    }
    const past = news.past ? `Not now: the scene shows ${news.past}` : "";
    if (part("past").textContent !== past) part("past").textContent = past;
    document.body.toggleAttribute("data-past", past !== "");
    keep(news.kept);
    for (const element of document.querySelectorAll("[data-live]")) {
      const value = news.live[element.dataset.live] ?? "–";
      if (element.textContent !== value) element.textContent = value;
    }
    banner(news.lost.map(([what, age]) => `${what} (since ${time(Date.now() - 1000 * age)})`), news.unknown);
  }

  // What moves the arm is off for those who may not; a button that is off for another reason stays so.
  function keep(why) {
    for (const element of document.querySelectorAll("[data-needs=arm]")) {
      const ours = element.dataset.kept !== undefined;
      if (why && (ours || element.getAttribute("aria-disabled") !== "true")) {
        element.dataset.kept = "";
        element.setAttribute("aria-disabled", "true");
        element.title = why;
      } else if (!why && ours) {
        delete element.dataset.kept;
        element.removeAttribute("aria-disabled");
        element.removeAttribute("title");
      }
    }
  }

  function banner(lines, unknown) {
    const text = lines.join(" — ");
    if (part("lost").textContent !== text) part("lost").textContent = text;
    part("lost").classList.toggle("on", text !== "");
    document.body.dataset.unknown = unknown.join(" ");
    if (part("how").style.opacity !== (unknown.includes("all") ? "0.4" : ""))
      part("how").style.opacity = unknown.includes("all") ? "0.4" : "";
  }

  setInterval(() => {
    const since = lostSince();
    if (since === null) return;
    letGo();
    banner([`No connection to the page's server: nothing here is of now, and STOP here does not reach the arm `
      + `(since ${time(since)})`], ["all"]);
    if (open() && Date.now() - heard > 4 * SILENT) { const old = socket; socket = null; old.close(); connect(); }
  }, 250);

  // --- STOP ---

  function stop() {
    letGo();
    asked += 1;
    const n = asked;
    say("Stopping …", "busy");
    const sent = send({do: "stop", n});  // tried also over a connection that seems to be lost
    if (!sent || lostSince() !== null) {
      say("NOT stopped: no connection", "bad");
      return;
    }
    waiting.set(n, setTimeout(() => { waiting.delete(n); say("NOT stopped: no answer", "bad"); }, ANSWER));
  }

  let pressed = 0;
  part("stop").addEventListener("pointerdown", event => {
    if (event.button === 0) { pressed = Date.now(); stop(); }
  });
  part("stop").addEventListener("click", () => { if (Date.now() - pressed > 1000) stop(); });  // by key, by a reader
  window.addEventListener("keydown", event => { if (event.key === "Escape" && !event.repeat) stop(); }, true);

  // --- other buttons ---

  const button = (target, what) => target instanceof Element ? target.closest(`[data-${what}]`) : null;
  const off = element => element.getAttribute("aria-disabled") === "true";

  document.addEventListener("click", event => {
    const element = button(event.target, "press");
    if (!element) return;
    if (off(element)) say(`${element.textContent.trim()}: ${element.title}`, "dim");
    else if (!send({do: "press", what: element.dataset.press})) say("no connection: nothing was done", "bad");
  });

  function grab(element, pointer) {
    if (held) return;
    if (off(element)) { say(`${element.getAttribute("aria-label")}: ${element.title}`, "dim"); return; }
    presses += 1;
    held = {what: element.dataset.hold, n: presses, pointer, timer: setInterval(again, AGAIN)};
    again();
  }

  function again() {
    if (!held) return;
    if (lostSince() !== null || !open() || socket.bufferedAmount > STUCK || document.hidden) { letGo(); return; }
    for (const element of document.querySelectorAll("[data-hold]"))
      element.classList.toggle("held", element.dataset.hold === held.what);
    send({do: "hold", what: held.what, n: held.n, at: performance.now(), seen});
  }

  function letGo() {
    if (!held) return;
    clearInterval(held.timer);
    held = null;
    for (const element of document.querySelectorAll("[data-hold].held")) element.classList.remove("held");
    send({do: "release"});
  }

  document.addEventListener("pointerdown", event => {
    const element = button(event.target, "hold");
    if (!element || event.button !== 0) return;
    if (element.hasPointerCapture?.(event.pointerId)) element.releasePointerCapture(event.pointerId);
    grab(element, event.pointerId);
  });
  document.addEventListener("pointermove", event => {
    if (!held || held.pointer !== event.pointerId) return;
    const under = button(document.elementFromPoint(event.clientX, event.clientY), "hold");
    if (!under || under.dataset.hold !== held.what || event.buttons === 0) letGo();
  }, true);
  for (const name of ["pointerup", "pointercancel"])
    window.addEventListener(name, event => { if (held && held.pointer === event.pointerId) letGo(); }, true);
  document.addEventListener("keydown", event => {
    const element = button(event.target, "hold");
    if (!element || (event.key !== " " && event.key !== "Enter")) return;
    event.preventDefault();
    if (!event.repeat) grab(element, event.key);
  });
  document.addEventListener("keyup", event => { if (held && held.pointer === event.key) letGo(); }, true);
  document.addEventListener("contextmenu", event => { if (button(event.target, "hold")) event.preventDefault(); });
  document.addEventListener("visibilitychange", letGo);
  document.documentElement.addEventListener("mouseleave", letGo);
  document.addEventListener("focusout", event => { if (held && typeof held.pointer === "string") letGo(); });
  for (const name of ["blur", "pagehide", "beforeunload"]) window.addEventListener(name, letGo);

  // --- names for screen readers ---

  // viser's fields stand beside their words, but do not say that these are their name.
  setInterval(() => {
    for (const input of document.querySelectorAll("#root input:not([aria-label])")) {
      if (input.type === "hidden" || (input.labels && input.labels.length)) continue;
      for (let row = input.closest(".mantine-Flex-root"); row; row = row.parentElement?.closest(".mantine-Flex-root")) {
        const words = row.firstElementChild?.textContent.trim() || "";
        if (/\p{L}/u.test(words)) { input.setAttribute("aria-label", words); break; }
      }
    }
  }, 1000);

  // --- begin ---

  window.zencellPage = key => { page = key; send({do: "page", what: key}); };  // called over viser's connection
  const begin = () => {
    document.body.prepend(bar);
    // viser's notice of a browser without a graphics card looks like a fault of the cell, and lies over the scene.
    new MutationObserver((_changes, watching) => {
      const notice = [...document.querySelectorAll(".mantine-Notification-root")]
        .find(each => each.textContent.includes("Software WebGL"));
      if (!notice) return;
      watching.disconnect();
      notice.querySelector("button")?.click();
      if (!part("note").textContent) say("this browser draws without a graphics card: the scene is slow", "dim");
    }).observe(document.body, {childList: true, subtree: true});
    new ResizeObserver(() =>
      document.documentElement.style.setProperty("--zc-bar", `${bar.offsetHeight}px`)).observe(bar);
    connect();
  };
  if (document.body) begin(); else document.addEventListener("DOMContentLoaded", begin);
})();

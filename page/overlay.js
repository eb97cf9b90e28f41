// The bar above the page: STOP and its result, the status of the cell, lost connections. It uses a WebSocket of its own
// (control_socket.py) that images never delay. Buttons of the panels use it too: one with data-press sends a message when
// it is clicked; one with data-hold sends messages while it is held down, and none afterwards. An image is enlarged by a
// click.
(() => {
  const HOLD_PERIOD = 40;  // [ms]
  const STATUS_TIMEOUT = 1500;  // [ms] without a status, after which the connection counts as lost; one is due each 250 ms
  const START_TIMEOUT = 6000;  // [ms] for the first status
  const STOP_TIMEOUT = 3000;  // [ms] for the result of STOP
  const NOTE_TIME = {good: 6000, dim: 6000, bad: 60000, busy: 60000};  // [ms] for which a note is shown
  const DWELL = 150, SLOP = 10;  // [ms], [px]: a finger that stays holds a button down, one that moves first scrolls
  const MAX_BUFFERED = 2000;  // [bytes] waiting to be sent: hold messages would arrive too late

  const ICONS = {".tabler-icon-adjustments": "Settings of this view", ".tabler-icon-list-search": "Search for a command",
    ".tabler-icon-chevrons-right": "Hide the panels", ".tabler-icon-chevrons-left": "Show the panels"};

  let socket = null, lastMessage = null, pageKey = "", stops = 0, pendingStops = new Map();
  let shownNote = 0, held = null, touch = null, presses = 0, statusTime = 0, noteEnd = 0, first = "", enlarged = null;
  const opened = Date.now();
  const bar = document.createElement("div");
  bar.id = "zc-bar";
  bar.innerHTML = `<div id="zc-row"><button id="zc-stop" type="button" title="Stop arm and task (Escape)"
      aria-label="STOP: stop arm and task" aria-keyshortcuts="Escape">STOP</button>
    <div id="zc-text"><div role="status" aria-live="polite"><b id="zc-state"></b> <span id="zc-hint"></span></div>
      <div id="zc-second"><span id="zc-summary"></span><span id="zc-note" role="status" aria-live="assertive"></span></div>
    </div><button id="zc-more" type="button" aria-expanded="false" title="Show the figures of the task">Details</button></div>
    <div id="zc-past" role="status"></div><div id="zc-lost" role="alert"></div>`;
  const part = id => bar.querySelector(`#zc-${id}`);
  const clock = when => new Date(when).toLocaleTimeString([], {hour12: false});
  const setText = (element, text) => { if (element.textContent !== text) element.textContent = text; };

  function notify(text, kind, age = 0) {
    const when = Date.now() - age;
    noteEnd = when + (NOTE_TIME[kind] ?? NOTE_TIME.bad);
    part("note").textContent = text && noteEnd > Date.now() ? `${clock(when)} ${text}` : "";
    part("note").className = kind || "";
  }

  // --- connection ---

  const isOpen = () => socket !== null && socket.readyState === WebSocket.OPEN;
  const lostSince = () => lastMessage === null ? (Date.now() - opened > START_TIMEOUT ? opened : null)
    : Date.now() - lastMessage > STATUS_TIMEOUT ? lastMessage : null;

  function connect() {
    const mine = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/control`);
    socket = mine;
    mine.onopen = () => { if (pageKey) send({do: "page", what: pageKey}); };
    mine.onmessage = event => { if (mine === socket) receive(JSON.parse(event.data)); };
    mine.onclose = () => { if (mine === socket) { release(); setTimeout(connect, 700); } };
  }

  function send(message) {
    if (!isOpen()) return false;
    socket.send(JSON.stringify(message));
    return true;
  }

  function receive(message) {
    lastMessage = Date.now();
    if (message.status) { statusTime = message.status.time; show(message.status); }
    if (message.result !== undefined) {
      clearTimeout(pendingStops.get(message.n));
      pendingStops.delete(message.n);
      if (message.kind === "bad" && message.n === 0) release();
      notify(message.result === first ? "" : message.result, message.kind);  // the first line shows a stop by itself
    }
  }

  function show(status) {
    const {text, kind, hint, since} = status.situation;
    first = text;
    setText(part("state"), since ? `${text} at ${clock(since)}` : text);
    part("state").className = kind;
    setText(part("hint"), hint);
    bar.dataset.kind = kind;
    const spans = status.summary.map(([text, kind]) => {
      const span = document.createElement("span");
      span.textContent = text;
      span.className = kind;
      return span.outerHTML;
    });
    const summary = spans.join(" · ");
    if (part("summary").dataset.shown !== summary) {
      part("summary").innerHTML = summary;
      part("summary").dataset.shown = summary;
    }
    if (status.note.number > shownNote) {
      if (shownNote || status.note.text) notify(status.note.text, status.note.kind, 1000 * status.note.age);
      shownNote = status.note.number;
    }
    if (Date.now() > noteEnd || part("note").textContent.endsWith(` ${text}`)) setText(part("note"), "");
    const past = status.past ? `Not live: the scene shows ${status.past}` : "";
    setText(part("past"), past);
    document.body.toggleAttribute("data-past", past !== "");
    block(status.blocked);
    for (const element of document.querySelectorAll("[data-live]")) {
      setText(element, status.live[element.dataset.live] ?? "–");
    }
    showLost(status.lost.map(([text, age]) => `${text} (since ${clock(Date.now() - 1000 * age)})`), status.stale);
  }

  // Disables the buttons that move the arm; buttons that are disabled for another reason stay disabled.
  function block(reason) {
    for (const element of document.querySelectorAll("[data-needs=arm]")) {
      const ours = element.dataset.blocked !== undefined;
      if (reason && (ours || element.getAttribute("aria-disabled") !== "true")) {
        element.dataset.blocked = "";
        element.setAttribute("aria-disabled", "true");
        element.title = reason;
      } else if (!reason && ours) {
        delete element.dataset.blocked;
        element.removeAttribute("aria-disabled");
        element.removeAttribute("title");
      }
    }
  }

  function showLost(lines, stale) {
    const text = lines.join(" — ");
    setText(part("lost"), text);
    part("lost").classList.toggle("on", text !== "");
    document.body.dataset.stale = stale.join(" ");
  }

  setInterval(() => {
    const since = lostSince();
    if (since === null) return;
    release();
    showLost([`No connection to the page's server: everything shown is out of date, and STOP on this page does not `
      + `reach the arm (since ${clock(since)})`], ["all"]);
    if (isOpen() && Date.now() - lastMessage > 4 * STATUS_TIMEOUT) {
      const old = socket;
      socket = null;
      old.close();
      connect();
    }
  }, 250);

  // --- STOP ---

  function stop() {
    release();
    stops += 1;
    const n = stops;
    notify("Stopping …", "busy");
    const sent = send({do: "stop", n});  // also over a connection that seems to be lost
    if (!sent || lostSince() !== null) {
      notify("NOT stopped: no connection", "bad");
      return;
    }
    pendingStops.set(n, setTimeout(() => { pendingStops.delete(n); notify("NOT stopped: no answer", "bad"); }, STOP_TIMEOUT));
  }

  let lastPress = 0;
  part("stop").addEventListener("pointerdown", event => {
    if (event.button === 0) { lastPress = Date.now(); stop(); }
  });
  // A click without a pointer press comes from the keyboard or a screen reader.
  part("stop").addEventListener("click", () => { if (Date.now() - lastPress > 1000) stop(); });
  window.addEventListener("keydown", event => { if (event.key === "Escape" && !event.repeat) stop(); }, true);

  // --- other buttons ---

  const button = (target, type) => target instanceof Element ? target.closest(`[data-${type}]`) : null;
  const isDisabled = element => element.getAttribute("aria-disabled") === "true";

  document.addEventListener("click", event => {
    const element = button(event.target, "press");
    if (!element) return;
    if (isDisabled(element)) notify(`${element.textContent.trim()}: ${element.title}`, "dim");
    else if (!send({do: "press", what: element.dataset.press})) notify("no connection: nothing was done", "bad");
  });

  function grab(element, pointer) {
    if (held) return;
    if (isDisabled(element)) { notify(`${element.getAttribute("aria-label")}: ${element.title}`, "dim"); return; }
    presses += 1;
    held = {what: element.dataset.hold, n: presses, pointer, timer: setInterval(hold, HOLD_PERIOD)};
    hold();
  }

  function hold() {
    if (!held) return;
    if (lostSince() !== null || !isOpen() || socket.bufferedAmount > MAX_BUFFERED || document.hidden) {
      release();
      return;
    }
    for (const element of document.querySelectorAll("[data-hold]"))
      element.classList.toggle("held", element.dataset.hold === held.what);
    send({do: "hold", what: held.what, n: held.n, at: performance.now(), seen: statusTime});
  }

  function release() {
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
    if (event.pointerType !== "touch") grab(element, event.pointerId);
    else if (!touch) touch = {id: event.pointerId, x: event.clientX, y: event.clientY,
      timer: setTimeout(() => grab(element, event.pointerId), DWELL)};
  });
  const lift = event => { if (touch && touch.id === event.pointerId) { clearTimeout(touch.timer); touch = null; } };
  document.addEventListener("touchmove", event => { if (held && event.cancelable) event.preventDefault(); }, {passive: false});
  document.addEventListener("pointermove", event => {
    if (!held && touch && Math.hypot(event.clientX - touch.x, event.clientY - touch.y) > SLOP) lift(event);
    if (!held || held.pointer !== event.pointerId) return;
    const under = button(document.elementFromPoint(event.clientX, event.clientY), "hold");
    if (!under || under.dataset.hold !== held.what || event.buttons === 0) release();
  }, true);
  for (const name of ["pointerup", "pointercancel"])
    window.addEventListener(name, event => { lift(event); if (held && held.pointer === event.pointerId) release(); }, true);
  document.addEventListener("keydown", event => {
    const element = button(event.target, "hold");
    if (!element || (event.key !== " " && event.key !== "Enter")) return;
    event.preventDefault();
    if (!event.repeat) grab(element, event.key);
  });
  document.addEventListener("keyup", event => { if (held && held.pointer === event.key) release(); }, true);
  document.addEventListener("contextmenu", event => { if (button(event.target, "hold")) event.preventDefault(); });
  document.addEventListener("visibilitychange", release);
  document.documentElement.addEventListener("mouseleave", release);
  document.addEventListener("focusout", event => { if (held && typeof held.pointer === "string") release(); });
  for (const name of ["blur", "pagehide", "beforeunload"]) window.addEventListener(name, release);

  // --- details on a phone, and enlarged images ---

  part("more").addEventListener("click", () => {
    part("more").setAttribute("aria-expanded", String(document.body.toggleAttribute("data-details")));
  });
  const picture = document.createElement("button");
  picture.id = "zc-picture";
  picture.type = "button";
  picture.title = "Close the image";
  picture.innerHTML = `<img alt="Enlarged image of the camera">`;
  picture.addEventListener("click", () => { enlarged = null; picture.remove(); });
  document.addEventListener("click", event => {
    if (!(event.target instanceof HTMLImageElement) || !event.target.closest("#root")) return;
    enlarged = event.target;
    document.body.append(picture);
  });
  setInterval(() => {  // it covers the 3D scene, neither STOP nor the panels
    if (!enlarged) return;
    const image = picture.firstElementChild, at = document.querySelector("#root canvas")?.getBoundingClientRect();
    if (enlarged.isConnected && image.src !== enlarged.src) image.src = enlarged.src;
    if (at) Object.assign(picture.style,
      {left: `${at.left}px`, top: `${at.top}px`, width: `${at.width}px`, height: `${at.height}px`});
  }, 100);

  // --- accessible names and tooltips ---

  // viser displays the label of a field next to it, but does not associate the two.
  setInterval(() => {
    // The upper panel takes no more height than it needs: the lower one has the buttons to jog.
    const upper = document.querySelector('[data-dock-leaf]:has([data-part="orders"])');
    const content = upper?.querySelector(".mantine-ScrollArea-content"), view = content?.parentElement;
    if (view) document.documentElement.style.setProperty(
      "--zc-upper", `${upper.offsetHeight - view.clientHeight + content.offsetHeight + 4}px`);
    for (const image of document.querySelectorAll("#root img:not([title])")) image.title = "Click to enlarge";
    for (const [icon, title] of Object.entries(ICONS))
      for (const element of document.querySelectorAll(`#root ${icon}`)) {
        const button = element.closest("button, [role=button]") || element.parentElement;
        if (!button.title) button.title = title;
      }
    for (const input of document.querySelectorAll("#root input:not([aria-label])")) {
      if (input.type === "hidden" || (input.labels && input.labels.length)) continue;
      for (let row = input.closest(".mantine-Flex-root"); row; row = row.parentElement?.closest(".mantine-Flex-root")) {
        const label = row.firstElementChild?.textContent.trim() || "";
        if (/\p{L}/u.test(label)) { input.setAttribute("aria-label", label); break; }
      }
    }
  }, 1000);

  // --- start ---

  window.zencellPage = key => { pageKey = key; send({do: "page", what: key}); };  // called by the server through viser
  const start = () => {
    document.body.prepend(bar);
    // viser's notice about software rendering looks like a fault of the cell and covers the scene.
    new MutationObserver((_changes, observer) => {
      const notice = [...document.querySelectorAll(".mantine-Notification-root")]
        .find(each => each.textContent.includes("Software WebGL"));
      if (!notice) return;
      observer.disconnect();
      notice.querySelector("button")?.click();
      document.body.dataset.software = "";  // the View tab shows it
    }).observe(document.body, {childList: true, subtree: true});
    new ResizeObserver(() =>
      document.documentElement.style.setProperty("--zc-bar", `${bar.offsetHeight}px`)).observe(bar);
    connect();
  };
  if (document.body) start(); else document.addEventListener("DOMContentLoaded", start);
})();

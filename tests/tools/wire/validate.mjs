// Validates msgpack payloads with the schemas of a folder, with nothing of zencell: node validate.mjs FOLDER PAYLOADS
// PAYLOADS is a JSON list of [message, payload in base64]. Prints the number of payloads by message, or fails.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { decode } from "@msgpack/msgpack";
import { Ajv2020 } from "ajv/dist/2020.js";

const [folder, payloads] = process.argv.slice(2);
const ajv = new Ajv2020({ strict: false, validateFormats: false });
const validators = {};
const counts = {};
const plain = (value) =>
  value instanceof Uint8Array ? "" : Array.isArray(value) ? value.map(plain)
  : typeof value === "bigint" ? Number(value)
  : value && typeof value === "object" ? Object.fromEntries(Object.entries(value).map(([k, v]) => [k, plain(v)]))
  : value;

for (const [message, payload] of JSON.parse(readFileSync(payloads))) {
  validators[message] ??= ajv.compile(JSON.parse(readFileSync(join(folder, "messages", `${message}.json`))));
  const value = plain(decode(Buffer.from(payload, "base64")));
  if (!validators[message](value)) throw new Error(`${message}: ${JSON.stringify(validators[message].errors[0])}`);
  counts[message] = (counts[message] ?? 0) + 1;
}
console.log(JSON.stringify(counts));

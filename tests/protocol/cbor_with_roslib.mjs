// Decodes CBOR by an unmodified roslib.js. Argument: path of roslib's module. Standard input: one message per line, base64.
// Standard output: one JSON per line. Numbers are strings in it, because JSON lacks NaN and large integers; typed
// arrays say what they are.
import { createInterface } from "node:readline";

const { AbstractTransport } = await import(process.argv[2]);

class Transport extends AbstractTransport {}

const transport = new Transport();
transport.on("message", (message) => console.log(JSON.stringify(plain(message.msg))));
transport.on("error", (error) => console.log(JSON.stringify({ error: String(error) })));

function plain(value) {
  if (typeof value === "number" || typeof value === "bigint") {
    return Object.is(value, -0) ? "-0" : String(value);
  }
  if (ArrayBuffer.isView(value)) {
    return { array: value.constructor.name, values: Array.from(value, plain) };
  }
  if (Array.isArray(value)) {
    return value.map(plain);
  }
  if (value !== null && typeof value === "object") {
    return Object.fromEntries(Object.entries(value).map(([name, part]) => [name, plain(part)]));
  }
  return typeof value === "string" ? { text: value } : value;
}

for await (const line of createInterface({ input: process.stdin })) {
  const bytes = Buffer.from(line, "base64");
  transport.handleRawMessage(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
}

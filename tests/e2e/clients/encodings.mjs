// An unmodified roslib.js user in Node who subscribes to one topic in one form and prints what it got as JSON.
// Arguments: path of roslib's module (2.x or 1.x), websocket URL, access token, topic, type, compression, fragment size.

import { connect, deadline } from "./connecting.mjs";

const [module, url, token, name, messageType, compression, fragmentSize] = process.argv.slice(2);
const loaded = await import(module);
const ROSLIB = loaded.Ros ? loaded : loaded.default;
const inTime = deadline(60, {});

// JSON has no typed arrays, no NaN and no large integers.
function shown(value) {
  if (ArrayBuffer.isView(value)) {
    return { array: value.constructor.name, values: Array.from(value, shown) };
  }
  if (typeof value === "bigint" || (typeof value === "number" && !Number.isFinite(value))) {
    return String(value);
  }
  if (Array.isArray(value)) {
    return value.map(shown);
  }
  if (value !== null && typeof value === "object") {
    return Object.fromEntries(Object.entries(value).map(([key, each]) => [key, shown(each)]));
  }
  return value;
}

const ros = await connect(ROSLIB, url, token);
const topic = new ROSLIB.Topic({ ros, name, messageType, compression });
if (fragmentSize !== "0") {
  // roslib.js takes fragments but has no option to ask for them.
  ros.callOnConnection({ op: "subscribe", id: "in parts", topic: name, fragment_size: Number(fragmentSize) });
}
const message = await new Promise((resolve) => topic.subscribe(resolve));
ros.close();
inTime();
console.log(JSON.stringify(shown(message)));
process.exit(0);

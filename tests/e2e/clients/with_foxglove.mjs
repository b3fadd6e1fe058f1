// Does as the apps do, with their own client class and parsers: decodes every channel, drives, calls, sets parameters.
// Prints what it saw as JSON. Arguments: websocket URL, access token ("" when the URL carries one), subprotocols.

import { createRequire } from "node:module";

const require = createRequire(import.meta.url);
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader, MessageWriter } = require("@foxglove/rosmsg2-serialization");

const [url, token, ...protocols] = process.argv.slice(2);
const ALL_SECONDS = 100;
const seen = { statuses: [], silent: [], decoded: {}, undecodable: {}, unparsable: {} };

const timer = setTimeout(() => {
  console.error("not in time", JSON.stringify(seen));
  process.exit(1);
}, ALL_SECONDS * 1000);

const headers = token ? { authorization: `Bearer ${token}` } : {};
const socket = new WebSocket(url, { protocols, headers });
const client = new FoxgloveClient({ ws: socket });
const channels = new Map();
const services = new Map();
const readers = new Map();
const subscribed = new Map();
const waiting = [];

/** Resolve when a condition holds; it is looked at again after every event. */
function until(condition) {
  return new Promise((resolve) => {
    waiting.push(() => {
      const found = condition();
      if (found) resolve(found);
      return Boolean(found);
    });
    look();
  });
}

function look() {
  for (const each of [...waiting]) {
    if (each()) waiting.splice(waiting.indexOf(each), 1);
  }
}

/** Resolve with the next event of a kind that fits. */
function next(event, fits = () => true) {
  return new Promise((resolve) => {
    const listener = (value) => {
      if (fits(value)) {
        client.off(event, listener);
        resolve(value);
      }
    };
    client.on(event, listener);
  });
}

const plain = (value) => JSON.parse(JSON.stringify(value, (_, each) => (typeof each === "bigint" ? Number(each) : each)));

client.on("error", (error) => {
  console.error("error", error);
  process.exit(1);
});
client.on("serverInfo", (info) => {
  seen.info ??= info;
  seen.first ??= Object.keys(seen.decoded).length === 0 && channels.size === 0;
  look();
});
client.on("status", (status) => {
  seen.statuses.push(status);
  look();
});
client.on("advertise", (found) => {
  for (const channel of found) {
    channels.set(channel.id, channel);
    try {
      if (channel.encoding === "cdr") readers.set(channel.id, new MessageReader(parse(channel.schema, { ros2: true })));
      // The apps take the fields of JSON from the properties of its schema.
      else Object.entries(JSON.parse(channel.schema).properties);
    } catch (error) {
      seen.unparsable[channel.topic] = String(error);
    }
    subscribed.set(client.subscribe(channel.id), channel);
  }
  look();
});
client.on("unadvertise", (ids) => ids.forEach((id) => channels.delete(id)));
client.on("advertiseServices", (found) => {
  found.forEach((service) => services.set(service.name, service));
  look();
});
const latest = {};
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const channel = subscribed.get(subscriptionId);
  try {
    const reader = readers.get(channel.id);
    latest[channel.topic] = reader ? reader.readMessage(data) : JSON.parse(new TextDecoder().decode(data));
    seen.decoded[channel.topic] = (seen.decoded[channel.topic] ?? 0) + 1;
    seen.timestamp = Number(timestamp / 1000000n);
  } catch (error) {
    seen.undecodable[channel.topic] = String(error);
  }
  look();
});

await until(() => seen.info);
seen.protocol = socket.protocol;
const operates = seen.info.capabilities.includes("clientPublish");
const MUST = ["/scan", "/odom", "/tf", "/tf_static", "/battery_state", "/relay/control"];
await until(() => MUST.every((topic) => latest[topic]));
seen.rays = latest["/scan"].ranges.length;
seen.frames = latest["/tf_static"].transforms.map((each) => each.child_frame_id);

// Services: calls at the same time, each with its own answer; then one that is not there.
function call(name, request = {}) {
  const service = services.get(name);
  const callId = call.number++;
  const half = (part) => parse(part.schema, { ros2: true });
  const body = new MessageWriter(half(service.request)).writeMessage(request);
  const answered = next("serviceCallResponse", (each) => each.callId === callId);
  const failed = next("serviceCallFailure", (each) => each.callId === callId);
  client.sendServiceCallRequest({ serviceId: service.id, callId, encoding: "cdr", data: new DataView(body.buffer, body.byteOffset, body.byteLength) });
  return Promise.race([
    answered.then((each) => plain(new MessageReader(half(service.response)).readMessage(each.data))),
    failed.then((each) => ({ failure: each.message })),
  ]);
}
call.number = 1;
const CALLED = operates ? ["/reset", "/relay/ping", "/reset"] : ["/relay/ping"];
await until(() => CALLED.every((name) => services.has(name)));
seen.answers = await Promise.all(CALLED.map((name) => call(name)));
seen.services = [...services.keys()];
services.set("/missing", { ...services.get("/relay/ping"), id: 999999 });
seen.missing = await call("/missing");

// Parameters: all, none that is known, one set by an integer with its type, one that is followed.
function parameters(names, id) {
  const answer = next("parameterValues", (each) => each.id === id);
  client.getParameters(names, id);
  return answer.then((each) => each.parameters);
}
const isSpeed = (each) => each.name.endsWith(".max_speed");
let all = await parameters([], "all");
// A node may be discovered before its services are.
for (let n = 0; operates && !all.some(isSpeed); n++) {
  await new Promise((resolve) => setTimeout(resolve, 500));
  all = await parameters([], `all-${n}`);
}
seen.parameters = all.length;
if (operates) {
  const speed = all.find(isSpeed);
  seen.speed = speed;
  seen.none = await parameters([`${speed.name}_unknown`], "none");
  client.subscribeParameterUpdates([speed.name]);
  const changed = next("parameterValues", (each) => each.id == undefined && each.parameters.some((one) => one.name === speed.name));
  const set = next("parameterValues", (each) => each.id === "set");
  client.setParameters([{ name: speed.name, value: 1, type: "float64" }], "set");
  seen.set = (await set).parameters;
  seen.changed = (await changed).parameters;
  const back = next("parameterValues", (each) => each.id === "back");
  client.setParameters([speed], "back");
  seen.back = (await back).parameters;
  const refused = next("status", (each) => each.message.includes("max_speed"));
  client.setParameters([{ name: speed.name, value: "fast" }], "refused");
  seen.refused = (await refused).message;
}

// The graph.
const graph = next("connectionGraphUpdate");
client.subscribeConnectionGraph();
seen.graph = await graph;
client.unsubscribeConnectionGraph();

// An asset that is not there.
const asset = next("fetchAssetResponse");
client.fetchAsset("package://nowhere/mesh.stl", 7);
const answer = await asset;
seen.asset = { status: answer.status, error: answer.error, requestId: answer.requestId };

// Motion, as the Teleop panel does it: ROS 1 spelling, and nothing is sent when the button is released.
if (operates) {
  const encoding = protocols.includes("foxglove.sdk.v1") ? "cdr" : "json";
  const channelId = client.advertise({ topic: "/cmd_vel", encoding, schemaName: "geometry_msgs/Twist" });
  const drive = [...channels.values()].find((each) => each.topic === "/cmd_vel");
  const twist = { linear: { x: 0.3, y: 0, z: 0 }, angular: { x: 0, y: 0, z: 0 } };
  const body = encoding === "cdr" ? new MessageWriter(parse(drive.schema, { ros2: true })).writeMessage(twist) : new TextEncoder().encode(JSON.stringify(twist));
  const first = latest["/odom"].pose.pose.position.x;
  // A client that drove while another user had control moves nothing until its controls were released for half a second.
  const begun = performance.now();
  const driving = setInterval(() => {
    if ((performance.now() - begun) % 3000 < 2000) client.sendMessage(channelId, body);
  }, 100);
  await until(() => Math.abs(latest["/odom"].pose.pose.position.x - first) > 0.05);
  clearInterval(driving);
  seen.moved = true;
  await until(() => Math.abs(latest["/odom"].twist.twist.linear.x) < 0.001);
  seen.stopped = true;
  client.unadvertise(channelId);
}

// Channels on which nothing has come: their definitions must do to write and read a message.
for (const { id, topic, schema } of channels.values()) {
  if (latest[topic] || !readers.has(id)) continue;
  try {
    readers.get(id).readMessage(new MessageWriter(parse(schema, { ros2: true })).writeMessage({}));
    seen.silent.push(topic);
  } catch (error) {
    seen.undecodable[topic] = String(error);
  }
}
seen.channels = [...channels.values()].map(({ topic, encoding, schemaName, schemaEncoding, schema }) => ({ topic, encoding, schemaName, schemaEncoding, schema }));
clearTimeout(timer);
client.close();
// Exit when all is written: a pipe takes 64 KiB at a time.
process.stdout.write(JSON.stringify(plain(seen)) + "\n", () => process.exit(0));

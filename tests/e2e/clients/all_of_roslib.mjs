// Everything roslib.js can do with ROS 2, once each, against the conformance suite's fixture node.
// Arguments: path of roslib's module, websocket URL, access token. Prints what came of it as JSON.

import { connect, deadline } from "./connecting.mjs";

const [module, url, token] = process.argv.slice(2);
const ROSLIB = await import(module);
const seen = {};
const inTime = deadline(90, seen);

/** A call with callbacks as a promise. */
const ask = (start) => new Promise((resolve, reject) => start(resolve, (error) => reject(new Error(error))));

const ros = await connect(ROSLIB, url, token);
const other = await connect(ROSLIB, url, token);

// --- rosapi ---
seen.topics = (await ask((ok, no) => ros.getTopics(ok, no))).topics;
seen.topicsForType = await ask((ok, no) => ros.getTopicsForType("std_msgs/msg/Int64", ok, no));
seen.topicType = await ask((ok, no) => ros.getTopicType("/conformance/counter", ok, no));
seen.services = await ask((ok, no) => ros.getServices(ok, no));
seen.servicesForType = await ask((ok, no) => ros.getServicesForType("std_srvs/srv/SetBool", ok, no));
seen.serviceType = await ask((ok, no) => ros.getServiceType("/conformance/invert", ok, no));
const request = await ask((ok, no) => ros.getServiceRequestDetails("std_srvs/srv/SetBool", ok, no));
seen.requestFields = request.typedefs[0].fieldnames;
const response = await ask((ok, no) => ros.getServiceResponseDetails("std_srvs/srv/SetBool", ok, no));
seen.responseFields = response.typedefs[0].fieldnames;
seen.nodes = await ask((ok, no) => ros.getNodes(ok, no));
seen.node = await ask((ok, no) => ros.getNodeDetails("/conformance/fixture", ok, no));
seen.actionServers = await ask((ok, no) => ros.getActionServers(ok, no));
const typedefs = await ask((ok, no) => ros.getMessageDetails("geometry_msgs/msg/Twist", ok, no));
seen.decoded = ros.decodeTypeDefs(typedefs);
const raw = await ask((ok, no) => ros.getTopicsAndRawTypes(ok, no));
seen.rawType = raw.typedefs_full_text[raw.topics.indexOf("/conformance/counter")];
seen.params = await ask((ok, no) => ros.getParams(ok, no));

// --- topics ---
const text = (name, more = {}) =>
  new ROSLIB.Topic({ ros, name, messageType: "std_msgs/msg/String", ...more });
const next = (topic) =>
  new Promise((resolve) => {
    const once = (message) => {
      topic.unsubscribe(once);
      resolve(message);
    };
    topic.subscribe(once);
  });
for (const compression of ["none", "png", "cbor"]) {
  const latched = text("/conformance/latched", { compression });
  seen[`latched ${compression}`] = await next(latched);
}
const cborRaw = await next(text("/conformance/latched", { compression: "cbor-raw" }));
seen["latched cbor-raw"] = { secs: typeof cborRaw.secs, nsecs: typeof cborRaw.nsecs, bytes: [...cborRaw.bytes] };

const out = text("/conformance/echo/out", { queue_length: 10, throttle_rate: 0 });
const echoed = new Promise((resolve) => out.subscribe(resolve));
const into = text("/conformance/echo/in", { queue_size: 5, latch: true });
into.advertise();
const saying = setInterval(() => into.publish({ data: "said by roslib.js" }), 100);
seen.echoed = await echoed;
clearInterval(saying);
into.unadvertise();
out.unsubscribe();

const slowed = [];
const throttled = new ROSLIB.Topic({
  ros, name: "/conformance/counter", messageType: "std_msgs/msg/Int64", throttle_rate: 200,
});
await new Promise((resolve) => throttled.subscribe((message) => slowed.push(message.data) === 4 && resolve()));
throttled.unsubscribe();
seen.throttled = slowed;
seen.publishers = await ask((ok, no) => text("/conformance/latched").getPublishers(ok, no));

// --- services, both ways ---
const invert = new ROSLIB.Service({ ros, name: "/conformance/invert", serviceType: "std_srvs/srv/SetBool" });
seen.inverted = await ask((ok, no) => invert.callService({ data: true }, ok, no));
const slow = new ROSLIB.Service({ ros, name: "/conformance/slow", serviceType: "std_srvs/srv/Trigger" });
seen.tooSlow = await ask((ok, no) => slow.callService({}, no, ok, 0.2)).catch((error) => `answered: ${error}`);
const absent = new ROSLIB.Service({ ros, name: "/nowhere", serviceType: "std_srvs/srv/Trigger" });
seen.absent = await ask((ok, no) => absent.callService({}, no, ok)).catch((error) => `answered: ${error}`);

const doing = new ROSLIB.Service({
  ros, name: "/conformance/do", serviceType: "rcl_interfaces/srv/ListParameters",
});
const fixture = async (...prefixes) => (await ask((ok, no) => doing.callService({ prefixes }, ok, no))).result.names;

const offered = new ROSLIB.Service({ ros, name: "/roslib/trigger", serviceType: "std_srvs/srv/Trigger" });
await offered.advertise((_, answer) => {
  answer.success = true;
  answer.message = "from roslib.js";
  return true;
});
seen.calledFromGraph = await fixture("call", "/roslib/trigger", "std_srvs/srv/Trigger", "{}");
const theirs = new ROSLIB.Service({ ros: other, name: "/roslib/trigger", serviceType: "std_srvs/srv/Trigger" });
seen.calledByOther = await ask((ok, no) => theirs.callService({}, ok, no));
await offered.unadvertise();
const later = new ROSLIB.Service({ ros, name: "/roslib/later", serviceType: "std_srvs/srv/SetBool" });
await later.advertiseAsync(async (request) => ({ success: !request.data, message: "later" }));
seen.calledLater = await fixture("call", "/roslib/later", "std_srvs/srv/SetBool", '{"data": true}');
await later.unadvertise();

// --- actions, both ways ---
const fibonacci = new ROSLIB.Action({
  ros, name: "/conformance/fibonacci", actionType: "example_interfaces/action/Fibonacci",
});
const feedback = [];
seen.result = await ask((ok, no) => fibonacci.sendGoal({ order: 5 }, ok, (each) => feedback.push(each), no));
seen.feedback = feedback;
seen.cancelled = await ask((ok, no) => {
  const id = fibonacci.sendGoal({ order: 900 }, ok, () => fibonacci.cancelGoal(id), no);
}).catch((error) => `failed: ${error.message}`);
seen.rejected = await ask((ok, no) => fibonacci.sendGoal({ order: 2000 }, no, undefined, ok)).catch(
  (error) => `succeeded: ${error}`,
);

const server = new ROSLIB.Action({
  ros, name: "/roslib/fibonacci", actionType: "example_interfaces/action/Fibonacci",
});
const wished = [];
server.advertise(
  (goal, id) => {
    server.sendFeedback(id, { sequence: [0, 1] });
    if (goal.order === 3) {
      server.setSucceeded(id, { sequence: [0, 1, 1, 2] });
    } else if (goal.order === 4) {
      server.setFailed(id);
    }
  },
  (id) => {
    wished.push(id);
    server.setCanceled(id, { sequence: [0] });
  },
);
const pursue = async (order, cancel = "0") =>
  JSON.parse(
    (await fixture("goal", "/roslib/fibonacci", "example_interfaces/action/Fibonacci", `{"order": ${order}}`, cancel))[0],
  );
seen.served = await pursue(3);
seen.servedFailed = await pursue(4);
seen.servedCanceled = await pursue(9, "1");
seen.cancelWishes = wished.length;
server.unadvertise();

// --- parameters ---
const param = new ROSLIB.Param({ ros, name: "/conformance/fixture:conformance.number" });
seen.before = await ask((ok, no) => param.get(ok, no));
seen.set = await ask((ok, no) => param.set(8, ok, no));
seen.after = await ask((ok, no) => param.get(ok, no));
await ask((ok, no) => param.set(7, ok, no));

// --- status, closing ---
const statuses = new Promise((resolve) => ros.on("status", resolve));
ros.setStatusLevel("error");
ros.callOnConnection({ op: "no_such_op" });
seen.status = await statuses;
const closed = new Promise((resolve) => ros.on("close", resolve));
ros.close();
await closed;
seen.closed = true;
other.close();

inTime();
console.log(JSON.stringify(seen));
process.exit(0);

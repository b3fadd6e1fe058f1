// An unmodified roslib.js asks all of rosapi it has helpers for. Prints what it saw as JSON.
// Arguments: path of roslib's module, websocket URL, access token, parameters as JSON (name, new value).

import { connect, deadline } from "./connecting.mjs";

const [module, url, token, parameters] = process.argv.slice(2);
const ROSLIB = await import(module);
const seen = {};
const inTime = deadline(60, seen);

const ros = await connect(ROSLIB, url, token);

const ask = (helper, ...args) => new Promise((resolve, reject) => ros[helper](...args, resolve, reject));
const NESTED = "switchboard_test_interfaces/msg/Nested";
const EVERYTHING = "switchboard_test_interfaces/srv/Everything";

seen.topics = await ask("getTopics");
seen.topicsForType = await ask("getTopicsForType", NESTED);
seen.topicType = await ask("getTopicType", "/lab/nested");
seen.raw = await ask("getTopicsAndRawTypes");
seen.services = await ask("getServices");
seen.servicesForType = await ask("getServicesForType", EVERYTHING);
seen.serviceType = await ask("getServiceType", "/lab/everything");
seen.request = await ask("getServiceRequestDetails", EVERYTHING);
seen.response = await ask("getServiceResponseDetails", EVERYTHING);
seen.nodes = await ask("getNodes");
seen.node = await ask("getNodeDetails", "/lab/arm");
seen.params = await ask("getParams");
seen.actions = await ask("getActionServers");
seen.details = await ask("getMessageDetails", NESTED);
seen.decoded = ros.decodeTypeDefs(seen.details);
seen.status = ros.decodeTypeDefs(await ask("getMessageDetails", "switchboard_msgs/msg/Status"));
const topic = new ROSLIB.Topic({ ros, name: "/lab/nested", messageType: NESTED });
seen.publishers = await new Promise((resolve, reject) => topic.getPublishers(resolve, reject));

seen.values = {};
for (const [name, value] of JSON.parse(parameters)) {
  const param = new ROSLIB.Param({ ros, name });
  const get = () => new Promise((resolve, reject) => param.get(resolve, reject));
  const set = (to) => new Promise((resolve, reject) => param.set(to, resolve, reject));
  const before = await get();
  await set(value);
  const after = await get();
  await set(before);
  seen.values[name] = [before, after, await get()];
}
const loose = new ROSLIB.Param({ ros, name: "/lab/arm:loose" });
seen.deleted = await new Promise((resolve, reject) => loose.delete(resolve, reject));
seen.afterDelete = await new Promise((resolve) => loose.get(() => resolve(""), resolve));
const fixed = new ROSLIB.Param({ ros, name: "/lab/arm:fixed" });
seen.fixed = await new Promise((resolve) => fixed.set(1, () => resolve(""), resolve));
const absent = new ROSLIB.Param({ ros, name: "/nobody:x" });
seen.absent = await new Promise((resolve) => absent.get(() => resolve(""), resolve));

ros.close();
inTime();
// More than a pipe holds: only when it is written may the process end.
process.stdout.write(JSON.stringify(seen) + "\n", () => process.exit(0));

// Does with a robot what a consumer of the Web of Things does, by node-wot: finds it in the directory, reads, observes,
// writes, invokes, queries and cancels. All descriptions are checked by the official JSON schemas.
// Prints what it saw as JSON. Arguments: address of the relay, access token, name of the robot, name of a Role.

import { createRequire } from "node:module";

const require = createRequire(import.meta.url);
const { Servient } = require("@node-wot/core");
const { HttpClientFactory } = require("@node-wot/binding-http");
const Ajv = require("ajv");
const addFormats = require("ajv-formats");

const [base, token, robot, role] = process.argv.slice(2);
const ALL_SECONDS = 100;
const seen = { invalid: {} };

const timer = setTimeout(() => {
  console.error("not in time", JSON.stringify(seen));
  process.exit(1);
}, ALL_SECONDS * 1000);

function validator(schema) {
  const ajv = new Ajv({ strict: false, allErrors: true });
  addFormats(ajv);
  return ajv.compile(require(schema));
}

const isThing = validator("wot-thing-description-types/schema/td-json-schema-validation.json");
const isModel = validator("wot-thing-model-types/schema/tm-json-schema-validation.json");

function check(name, validate, description) {
  if (!validate(description)) {
    seen.invalid[name] = validate.errors.map((each) => `${each.instancePath} ${each.message}`).slice(0, 5);
  }
}

async function get(path, accept) {
  const answer = await fetch(base + path, { headers: { authorization: `Bearer ${token}`, accept } });
  return { media: answer.headers.get("content-type"), body: await answer.json() };
}

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

const servient = new Servient();
servient.addClientFactory(new HttpClientFactory(null));
const wot = await servient.start();

async function consume(description) {
  check(description.title, isThing, description);
  servient.addCredentials({ [description.id]: { token } });
  return wot.consume(description);
}

// The directory
const introduction = await wot.requestThingDescription(`${base}/.well-known/wot`);
check("directory", isThing, introduction);
servient.addCredentials({ [introduction.id]: { token } });
const things = {};
const directory = await wot.exploreDirectory(`${base}/.well-known/wot`);
for await (const each of directory) {
  check(each.title, isThing, each);
  things[each.title] = each;
}
seen.directoryError = directory.error?.message ?? null;
seen.things = Object.keys(things);
const consumedDirectory = await wot.consume(introduction);
const retrieved = await consumedDirectory.invokeAction("retrieveThing", undefined, {
  uriVariables: { id: things[robot].id },
});
seen.retrieved = (await retrieved.value()).title;

// The robot
const thing = await consume(things[robot]);
const read = async (name, options) => (await thing.readProperty(name, options)).value();
const invoke = async (name, input, options) => (await thing.invokeAction(name, input, options)).value();

seen.odom = Object.keys((await read("odom")).value);
seen.scan = (await read("scan")).type;

async function observe(name, wanted) {
  const values = [];
  const subscription = await thing.observeProperty(name, async (data) => {
    const value = (await data.value()).value.data;
    if (values.length < wanted) values.push(value);
  });
  return { values, subscription };
}

const counter = await observe("conformance/counter", 3);
while (counter.values.length < 3) await pause(20);
await counter.subscription.stop();
seen.observed = counter.values;

const echo = await observe("conformance/echo/out", 1);
while (echo.values.length < 1) {
  await thing.writeProperty("conformance/echo/in", { value: { data: "written by node-wot" } });
  await pause(50);
}
await echo.subscription.stop();
seen.echoed = echo.values[0];

seen.inverted = (await invoke("conformance/invert", { args: { data: true } })).values;

const refused = await thing.writeProperty("cmd_vel", { value: {} }).catch((error) => error.message);
for (let moved = false; !moved; ) {
  const uriVariables = await read("freshness-token");
  // On a busy machine the token may be too old when it arrives.
  moved = await thing.writeProperty("cmd_vel", { value: { angular: { z: 0.1 } } }, { uriVariables }).then(
    () => true,
    () => false,
  );
}
seen.moved = [refused, (await invoke("relay/release_control", {})).values.success];

async function goal(order) {
  const begun = await invoke("conformance/fibonacci", { goal: { order }, poll_timeout: 100 });
  return { uriVariables: { id: begun.id } };
}

async function ended(options) {
  for (;;) {
    const status = await read("goal-status", options);
    if (status.ended !== null) return status;
    await pause(50);
  }
}

const whole = await ended(await goal(5));
seen.result = [whole.state, whole.result.sequence];
const stopped = await goal(1000);
await thing.invokeAction("cancel-goal", undefined, stopped);
seen.cancelled = (await ended(stopped)).state;

// Parameters and cameras
const [{ name }] = (await read("parameter-list")).params;
seen.parameter = `/${(await read("parameter", { uriVariables: { name } })).name}` === name;
const camera = Object.keys(things[robot].properties).find((each) => each.startsWith("image-of-"));
const image = new Uint8Array(await (await thing.readProperty(camera)).arrayBuffer());
seen.image = [...image.slice(0, 2)];

// The Role
const model = await get(`/api/v1/roles/${role}/tm`, "application/tm+json");
check("model", isModel, model.body);
seen.model = [model.media, Object.keys(model.body.properties), Object.keys(model.body.actions)];
const ofRole = await consume((await get(`/api/v1/roles/${role}/td`, "application/td+json")).body);
const element = await (await ofRole.readProperty("COUNT")).value();
seen.element = [element.element, typeof element.value];
const called = await (await ofRole.invokeAction("INVERT", { args: { data: false } })).value();
seen.called = called.values;
const execute = (order, timeout) => ofRole.invokeAction("FIBONACCI", { args: { order }, timeout });
seen.executed = (await (await execute(5, 60)).value()).values;
seen["too long"] = await execute(1000, 0.2).catch((error) => error.message);

console.log(JSON.stringify(seen));
clearTimeout(timer);
process.exit(0);

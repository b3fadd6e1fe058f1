// An unmodified roslib.js user in Node that offers a service and an action, and sends a goal to each of two actions.
// Prints what it saw as JSON.
// Arguments: path of roslib's module, websocket URL, access token, the service and the action it offers, an action, and
// one whose goals are to be cancelled.

import { connect, deadline } from "./connecting.mjs";

const [module, url, token, serviceName, offeredName, actionName, endlessName] = process.argv.slice(2);
const ROSLIB = await import(module);
const seen = { feedback: [] };
const inTime = deadline(90, seen);

const ros = await connect(ROSLIB, url, token);

const actionType = "example_interfaces/action/Fibonacci";
const service = new ROSLIB.Service({ ros, name: serviceName, serviceType: "example_interfaces/srv/AddTwoInts" });
const called = new Promise((resolve) => {
  service.advertise((request, response) => {
    response.sum = request.a + request.b;
    resolve(request);
    return true;
  });
});

const offered = new ROSLIB.Action({ ros, name: offeredName, actionType });
const cancelled = new Promise((resolve) => {
  offered.advertise(
    (goal, id) => {
      offered.sendFeedback(id, { sequence: [goal.order] });
      if (goal.order < 100) {
        offered.setSucceeded(id, { sequence: [0, 1, goal.order] });
      }
    },
    (id) => {
      offered.setCanceled(id, { sequence: [0] });
      resolve(true);
    },
  );
});
console.log("offered");
seen.request = await called;
seen.asked_to_cancel = await cancelled;

const action = new ROSLIB.Action({ ros, name: actionName, actionType });
seen.result = await new Promise((resolve, reject) =>
  action.sendGoal({ order: 5 }, resolve, (feedback) => seen.feedback.push(feedback.sequence), reject),
);
const endless = new ROSLIB.Action({ ros, name: endlessName, actionType });
seen.failure = await new Promise((resolve) => {
  let id;
  const stop = () => endless.cancelGoal(id);
  id = endless.sendGoal({ order: 5 }, () => resolve("a result"), stop, resolve);
});
offered.unadvertise();
service.unadvertise();
ros.close();
inTime();
console.log(JSON.stringify(seen));

// An unmodified roslib.js user in Node: lists, subscribes, drives, calls. Prints what it saw as JSON.
// Arguments: path of roslib's module, websocket URL, access token ("" when the URL carries a ticket).

import { connect, deadline } from "./connecting.mjs";

const [module, url, token] = process.argv.slice(2);
const ROSLIB = await import(module);
const seen = {};
const inTime = deadline(110, seen);

const ros = await connect(ROSLIB, url, token);

const topics = await new Promise((resolve, reject) => ros.getTopics(resolve, reject));
seen.topics = topics.topics;
seen.services = await new Promise((resolve, reject) => ros.getServices(resolve, reject));
seen.scan_type = await new Promise((resolve, reject) => ros.getTopicType("/scan", resolve, reject));

const scan = new ROSLIB.Topic({ ros, name: "/scan", messageType: "sensor_msgs/msg/LaserScan" });
const odom = new ROSLIB.Topic({ ros, name: "/odom", messageType: "nav_msgs/msg/Odometry" });
seen.rays = await new Promise((resolve) => scan.subscribe((message) => resolve(message.ranges.length)));
seen.scanned = true;

// Who began to drive while another still had control, or was late, moves nothing until he has let go for half a second.
const STROKE = 2000;
const PAUSE = 1000;
let first;
let moved = false;
await new Promise((resolve) => {
  const command = new ROSLIB.Topic({ ros, name: "/cmd_vel", messageType: "geometry_msgs/msg/Twist" });
  const begun = performance.now();
  let driving;
  odom.subscribe((message) => {
    const x = message.pose.pose.position.x;
    first ??= x;
    driving ??= setInterval(() => {
      if ((performance.now() - begun) % (STROKE + PAUSE) < STROKE) {
        command.publish({ linear: { x: 0.3 } });
      }
    }, 100);
    if (!moved && Math.abs(x - first) > 0.05) {
      moved = true;
      clearInterval(driving);
      command.publish({});
      command.unadvertise();
      resolve();
    }
  });
});
seen.odom = first !== undefined;
seen.moved = moved;

const reset = new ROSLIB.Service({ ros, name: "/reset", serviceType: "std_srvs/srv/Trigger" });
seen.reset = await new Promise((resolve, reject) => reset.callService({}, resolve, reject));
scan.unsubscribe();
odom.unsubscribe();
ros.close();
inTime();
console.log(JSON.stringify(seen));
process.exit(0);

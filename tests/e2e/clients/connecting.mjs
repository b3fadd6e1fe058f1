// What every client of roslib.js here begins with.

/** A connection, logged in by the token unless that is "": then the URL carries a ticket. */
export async function connect(ROSLIB, url, token) {
  const ros = new ROSLIB.Ros();
  await new Promise((resolve, reject) => {
    ros.on("connection", resolve);
    ros.on("error", reject);
    ros.connect(url);
  });
  if (token) {
    ros.authenticate(token, "test", "relay", "random", 0, "any", 0);
  }
  return ros;
}

/** Ends the process, with what was seen so far, unless the function it returns is called in time. */
export function deadline(seconds, seen) {
  const late = setTimeout(() => {
    console.error(`not done within ${seconds} s; so far: ${JSON.stringify(seen)}`);
    process.exit(1);
  }, seconds * 1000);
  return () => clearTimeout(late);
}

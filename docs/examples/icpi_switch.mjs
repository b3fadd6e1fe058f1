// A program that gives commands, by ICPI: it toggles a lamp, reads it, and tells all programs of its user.
// docs/guides/icpi.md explains it. Runs in Node.js 22 and in browsers.
//
// SWITCHBOARD_TOKEN=… node icpi_switch.mjs ws://127.0.0.1:9090/icpi switch lamp

const [url, name, lamp] = process.argv.slice(2);

const escape = (text) => text.replace(/[%!(]/g, (found) => `%${found.charCodeAt(0).toString(16).toUpperCase()}`);

function write(dest, id, fx, args, { ak = 1, br = 0 } = {}) {
	const values = args.map((each, number) => `(${number})${escape(each)}`).join("");
	return `${dest}!sn!${name}!id!${id}!ak!${ak}!fx!${fx}!ar!${values}!br!${br}`;
}

function read(text) {
	const parts = text.split("!");
	const args = parts[10].split(/\(\d+\)/).slice(1).map(decodeURIComponent);
	return { id: Number(parts[4]), fx: parts[8], args };
}

// The token is a subprotocol, since browsers send no headers of their own with a websocket.
const relay = new WebSocket(url, [`bearer.${process.env.SWITCHBOARD_TOKEN}`]);
const waiting = new Map();
let last = 0;

function request(dest, fx, args = [], how = {}) {
	return new Promise((resolve, reject) => {
		waiting.set(++last, { resolve, reject });
		relay.send(write(dest, last, fx, args, how));
	});
}

relay.onmessage = ({ data }) => {
	const { id, fx, args } = read(data);
	if (fx !== "reply" || !waiting.has(id)) return;
	const { resolve, reject } = waiting.get(id);
	waiting.delete(id);
	if (args[0] === "ok") resolve(args[1]);
	else reject(new Error(args[1]));
};

relay.onclose = ({ code, reason }) => console.log(`closed: ${code} ${reason}`);

relay.onopen = async () => {
	try {
		await request("relay", "register", [name, "[]", "[]"]);
		await request(lamp, "toggle");
		console.log(`the lamp is ${JSON.parse(await request(lamp, "get", ["power"])) ? "on" : "off"}`);
		console.log(`${await request("", "toggled", [lamp], { br: 1 })} programs were notified`);
		await request(lamp, "explode").catch((error) => console.log(error.message));
	} finally {
		relay.close();
	}
};

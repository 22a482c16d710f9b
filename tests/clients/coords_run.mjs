// The page's own coordinate text, outside of a browser: [[lat, lon]..] on standard input, one object each out.
import { readFileSync } from "node:fs";

const source = readFileSync(new URL("../../src/ground/page/coords.js", import.meta.url));
const { decimal, dms, mgrs, utm } = await import(`data:text/javascript;base64,${source.toString("base64")}`);

const places = JSON.parse(readFileSync(0, "utf8"));
const told = ([lat, lon]) => ({ decimal: decimal(lat, lon), dms: dms(lat, lon), mgrs: mgrs(lat, lon), utm: utm(lat, lon) });
console.log(JSON.stringify(places.map(told)));

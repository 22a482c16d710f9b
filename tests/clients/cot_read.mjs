// CoT events, one JSON string a line on standard input, through @tak-ps/node-cot; GeoJSON on standard output.
// EMBERFIX_NODE is the folder that holds node_modules (default: .x/node).
import { dirname, join } from "node:path";
import { createInterface } from "node:readline";
import { fileURLToPath, pathToFileURL } from "node:url";

const modules = process.env.EMBERFIX_NODE ?? join(dirname(fileURLToPath(import.meta.url)), "../../.x/node");
const library = join(modules, "node_modules/@tak-ps/node-cot/dist/index.js");
const { CoTParser } = await import(pathToFileURL(library).href);

const features = [];
for await (const line of createInterface({ input: process.stdin })) {
  const cot = CoTParser.from_xml(JSON.parse(line));
  const feature = await CoTParser.to_geojson(cot);
  features.push({ ...feature, deletes: Boolean(cot.raw.event.detail?.__forcedelete) });
}
console.log(JSON.stringify({ features }));

// CoT events, one JSON string a line on standard input, through @tak-ps/node-cot; GeoJSON on standard output.
// EMBERFIX_NODE is the folder that holds node_modules (default: .x/node).
import { createRequire } from "node:module";
import { dirname, join } from "node:path";
import { createInterface } from "node:readline";
import { fileURLToPath, pathToFileURL } from "node:url";

const modules = process.env.EMBERFIX_NODE ?? join(dirname(fileURLToPath(import.meta.url)), "../../.x/node");
const found = createRequire(join(modules, "package.json")).resolve("@tak-ps/node-cot");
const { CoTParser } = await import(pathToFileURL(found).href);

const features = [];
for await (const line of createInterface({ input: process.stdin })) {
  const cot = CoTParser.from_xml(JSON.parse(line));
  const feature = await CoTParser.to_geojson(cot);
  features.push({ ...feature, deletes: Boolean(cot.raw.event.detail?.__forcedelete) });
}
console.log(JSON.stringify({ features }));

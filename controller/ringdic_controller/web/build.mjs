// Bundles the page: node build.mjs OUT. Writes index.html, hashed assets and manifest.json; needs no network.
import { mkdir, readFile, writeFile } from "node:fs/promises";
import { basename, join } from "node:path";
import { build } from "esbuild";

const out = process.argv[2];
if (!out) throw new Error("usage: node build.mjs OUT");

const { metafile } = await build({
  entryPoints: ["src/main.js", "src/page.css"],
  outdir: join(out, "assets"),
  entryNames: "[name]-[hash]",
  chunkNames: "[name]-[hash]",
  bundle: true,
  splitting: true,
  format: "esm",
  target: "es2022",
  minify: true,
  legalComments: "eof",
  metafile: true,
});

const assets = {};
for (const [path, output] of Object.entries(metafile.outputs)) {
  if (output.entryPoint) assets[basename(output.entryPoint)] = `assets/${basename(path)}`;
}
const html = await readFile("index.html", "utf8");
const page = html.replace(/\{\{([\w.]+)\}\}/g, (_, name) => {
  if (!assets[name]) throw new Error(`index.html names ${name}, which was not built`);
  return assets[name];
});
await mkdir(out, { recursive: true });
await writeFile(join(out, "index.html"), page);
await writeFile(join(out, "manifest.json"), `${JSON.stringify({ assets }, null, 2)}\n`);

// Builds the page into deploy/serve/page: one script, one style sheet, one document. `--check` compares instead of writing.
import { build } from "esbuild";
import { mkdir, readFile, writeFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const target = join(here, "..", "deploy", "serve", "page");

const bundled = await build({
  absWorkingDir: here,
  entryPoints: { page: "src/main.ts" },
  outdir: "out",
  write: false,
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  charset: "utf8",
  legalComments: "inline",
  metafile: false,
});
const styles = await build({
  absWorkingDir: here,
  entryPoints: { page: "src/page.css" },
  outdir: "out",
  write: false,
  bundle: true,
  minify: true,
  charset: "utf8",
});
const files = new Map([
  ["page.js", bundled.outputFiles[0].text],
  ["page.css", styles.outputFiles[0].text],
  ["index.html", await readFile(join(here, "src", "index.html"), "utf8")],
  ["icon.svg", await readFile(join(here, "src", "icon.svg"), "utf8")],
]);

let differs = 0;
await mkdir(target, { recursive: true });
for (const [name, text] of files) {
  const path = join(target, name);
  if (process.argv.includes("--check")) {
    const there = await readFile(path, "utf8").catch(() => "");
    if (there !== text) {
      console.error(`${name}: the built page is not what its sources give: run \`make page\``);
      differs = 1;
    }
  } else {
    await writeFile(path, text);
    console.log(`${name}: ${text.length} characters`);
  }
}
process.exit(differs);

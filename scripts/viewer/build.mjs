// Bundles Spark and three.js into ambiguous_wild/viewing/page/renderer.js.gz, with their licences beside it.
import { build } from "esbuild";
import { readFileSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";

const target = new URL("../../ambiguous_wild/viewing/page/", import.meta.url);
const result = await build({
  entryPoints: ["entry.js"], bundle: true, minify: true, format: "esm", target: "es2022", write: false,
  legalComments: "none", // their full texts are in licences.txt
});
// Spark's worker names a map that is not there.
const program = result.outputFiles[0].text.replace(/\/\/# sourceMappingURL=[\w.-]+/g, "");
writeFileSync(new URL("renderer.js.gz", target), gzipSync(program, { level: 9 }));
const licences = ["@sparkjsdev/spark", "three", "fflate"].map((name) => {
  const { version } = JSON.parse(readFileSync(`node_modules/${name}/package.json`));
  return `${name} ${version}\n\n${readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim()}\n`;
});
writeFileSync(new URL("licences.txt", target), licences.join("\n----\n\n"));

// A run: its numbers, hashes, and the commands that make it again.

const opened = (runs, width) => h("tr", { class: "more" }, h("td", { colspan: width }, h("div", { class: "runs" }, ...runs.map(oneRun))));

function oneRun(run) {
  const values = DATA.order.filter((k) => Object.hasOwn(run.quality, k)).map((k) => `${measure(k).label} ${shown(valueOf(run, k), measure(k).digits)}`);
  const checked = run.checked === "photos" ? "metrics computed again from its renders" : run.checked === "psnr" ? "PSNR computed again from its renders" : "files and hashes checked, the scene was not at hand";
  const load = { true: "alone on the machine", false: "shared the machine", null: "load not recorded" }[run.alone];
  const code = h("code", {}, commands(run));
  return h("div", { class: "run" },
    h("p", {}, h("strong", {}, `${run.scene}, seed ${run.seed}`), `: ${values.join(", ")}`),
    h("p", { class: "small" }, `${run.images} test images; ${checked}; ${run.device}, ${run.hardware}, ${load}; version ${run.version}; configuration ${run.config_hash.slice(0, 12)}, scene ${run.scene_hash.slice(0, 12)}, result ${run.result_hash.slice(0, 12)}${run.source ? `, its file ${run.source.slice(0, 12)}` : ""}${run.code_hash ? `, code ${run.code_hash.slice(0, 12)}` : ""}`),
    Object.hasOwn(DATA.models, run.result_hash) ? h("p", {}, h("a", { href: DATA.models[run.result_hash] }, "Fly through the model")) : null,
    needs(run),
    h("div", { class: "row" }, code, h("button", { type: "button", class: "copy", "aria-label": "Copy the commands", onclick: (e) => copy(code, e.currentTarget) }, "Copy")));
}

/** One command a line, and what to expect as a comment: fit to be pasted into a shell. */
function commands(run) {
  const psnr = shown(valueOf(run, "psnr"), 3);
  const expect = `# version ${run.version}: expect scene ${run.scene_hash.slice(0, 12)} and PSNR ${psnr}`;
  return `${run.reproduce.split(" && ").join(" &&\n")}\n${expect.replace(/[^\x20-\x7e]/g, "?")}`;
}

/** What the commands need besides an empty folder; null for nothing. */
function needs(run) {
  const lacking = [];
  if (!run.reproduce.startsWith("aw simulate ") && !run.reproduce.startsWith("printf %s ")) lacking.push(`the scene with hash ${run.scene_hash.slice(0, 12)} as folder ${run.scene}`);
  if (run.source) lacking.push(`the method's file, whose hash (source) is ${run.source.slice(0, 12)}`);
  return lacking.length ? h("p", { class: "small" }, `Before the command: ${lacking.join("; ")}.`) : null;
}

async function copy(code, button) {
  try {
    await navigator.clipboard.writeText(code.textContent);
  } catch {
    // No clipboard from a file in some browsers: the old way.
    getSelection().selectAllChildren(code);
    document.execCommand("copy");
  }
  button.textContent = "Copied";
  setTimeout(() => { button.textContent = "Copy"; }, 1500);
}

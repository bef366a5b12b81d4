"use strict";
// What the page knows, and means that keep what is missing missing.
const DATA = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const ALL = "*"; // as a metric: every column
const MAIN = ["psnr", "ssim", "lpips_alex", "psnr_covered", "mask_iou", "reference_s", "gaussians"]; // columns at first
const COSTS = ["reference_s", "train_s", "model_mb", "fps", "gaussians"];
const state = { dataset: "", off: new Set(), metric: "", method: "", reported: true, sort: {}, open: new Set(), cell: null };

/** An element; children that are strings become text, never markup. */
function h(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value !== null && value !== undefined) element.setAttribute(key, value);
  }
  element.append(...children.filter((c) => c !== null && c !== undefined));
  return element;
}

function svg(name, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

const number = (value) => (value === "inf" ? Infinity : value === "-inf" ? -Infinity : value ?? NaN);
const unique = (values) => [...new Set(values)];
const byName = (a, b) => a.localeCompare(b, "en", { numeric: true, sensitivity: "base" }) || (a < b ? -1 : a > b ? 1 : 0);
/** Mean of the finite values; missing where a value is missing or none is finite. */
function mean(values) {
  const finite = values.filter(Number.isFinite);
  return finite.length && !values.some(Number.isNaN) ? finite.reduce((a, b) => a + b, 0) / finite.length : NaN;
}
const groupKey = (run) => JSON.stringify([run.method, run.setting, run.options]);
const measure = (key) => (Object.hasOwn(DATA.measures, key) ? DATA.measures[key] : { label: key, better: null, digits: 3 });
const isTime = (key) => DATA.times.includes(key);

/** Sample deviation of the finite values; NaN for fewer than two. */
function spread(all) {
  const values = all.filter(Number.isFinite);
  if (values.length < 2) return NaN;
  const m = mean(values);
  return Math.sqrt(values.reduce((a, v) => a + (v - m) ** 2, 0) / (values.length - 1));
}

function shown(value, digits) {
  if (Number.isNaN(value)) return "–";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "-∞";
  return digits === 0 ? Math.round(value).toLocaleString("en") : value.toFixed(digits);
}

const valueOf = (run, key) => number(Object.hasOwn(run.quality, key) ? run.quality[key] : Object.hasOwn(run.cost, key) ? run.cost[key] : NaN);
const runsOf = (dataset) => DATA.runs.filter((r) => r.dataset === dataset);
const scenesOf = (dataset) => unique(runsOf(dataset).map((r) => r.scene)).sort(byName);
const chosenScenes = () => scenesOf(state.dataset).filter((s) => !state.off.has(s));
/** The datasets: simulated suites, whose scenes are known, then the one with most runs. */
const known = (dataset) => Number(Object.hasOwn(DATA.scenes, dataset));
const measuredDatasets = () => unique(DATA.runs.map((r) => r.dataset)).sort((a, b) => known(b) - known(a) || runsOf(b).length - runsOf(a).length || byName(a, b));

/** The options of a group's command without the method's name. */
const changedOptions = (group) =>
  [...group.runs[0].reproduce.matchAll(/--set [^\s.]+\.(\S+)/g)].map((match) => match[1]).join(", ") || "default options";

/** Every group of runs of a dataset that differ in scene and seed alone. No filter: ranks count all of them. */
function groups(dataset) {
  const found = new Map();
  for (const run of runsOf(dataset)) {
    const key = groupKey(run);
    if (!found.has(key)) found.set(key, { key, method: run.method, setting: run.setting, options: run.options, runs: [] });
    found.get(key).runs.push(run);
  }
  const all = [...found.values()];
  for (const g of all) {
    // Options are named where methods and settings alone do not tell groups apart.
    const twins = all.filter((o) => o.method === g.method && o.setting === g.setting);
    const set = changedOptions(g);
    const alike = twins.some((o) => o !== g && changedOptions(o) === set);
    const about = twins.length > 1 ? `${g.setting}, ${set}${alike ? ` (${g.options})` : ""}` : g.setting;
    g.about = about.replaceAll("+", " + "); // lines break between effects, not inside a word
  }
  return all;
}

/** Whether the search lets a method through; it looks at the name alone. */
const asked = (method) => method.toLowerCase().includes(state.method.trim().toLowerCase());

/** The scenes on which a measure is defined: all, but for parts of a picture and masks only where any run has a value. */
function definedScenes(key, scenes) {
  if (!DATA.partial.includes(key)) return scenes;
  const runs = runsOf(state.dataset);
  return scenes.filter((s) => runs.some((r) => r.scene === s && !Number.isNaN(valueOf(r, key))));
}

/** Mean over seeds, then over scenes: {value, spread, seeds, low, high, comparable, cells}; missing where a scene or a value is. */
function summary(group, key, all) {
  const scenes = definedScenes(key, all);
  const runs = scenes.map((scene) => group.runs.filter((r) => r.scene === scene).sort((a, b) => a.seed - b.seed));
  const values = runs.map((of) => of.map((r) => valueOf(r, key)));
  const flat = values.flat(), cells = { all: flat.length, finite: flat.filter(Number.isFinite).length };
  const value = mean(values.map(mean));
  const seeds = runs[0]?.map((r) => r.seed) ?? [];
  // Seed by seed, so that the spread is that of the number shown: needs the same seeds in every scene.
  const same = runs.every((of) => of.length === seeds.length && of.every((r, i) => r.seed === seeds[i]));
  const bySeed = same && !Number.isNaN(value) ? seeds.map((_, i) => mean(runs.map((of) => valueOf(of[i], key)))) : [];
  const comparable = !isTime(key) || runs.flat().every((r) => r.alone === true);
  const low = mean(values.map((v) => Math.min(...v))), high = mean(values.map((v) => Math.max(...v)));
  return { value, spread: spread(bySeed), seeds: bySeed, comparable, low, high, cells };
}

/** Whether a method saw exact masks or clean photos: such a reference is not ranked. */
const isReference = (group) => DATA.references.includes(group.method);

/** What is ranked of summaries: no reference, no time of a shared machine, no times of different machines. */
function rankable(found, summaries, key) {
  const open = found.map((g, i) => !isReference(g) && summaries[i].comparable && !Number.isNaN(summaries[i].value));
  const of = (what) => unique(found.filter((_, i) => open[i]).flatMap((g) => g.runs.map((r) => r[what])));
  // Reference seconds compare machines, but not a CPU with a GPU.
  const apart = isTime(key) && of(key === "reference_s" ? "device" : "hardware").length > 1;
  return summaries.map((s, i) => (open[i] && !apart ? s.value : NaN));
}

/** Rank 1, 2, 3 of each value, or null; equal in print is equal in rank. */
function ranks(values, key) {
  const { better, digits } = measure(key);
  const printed = values.map((v) => (Number.isFinite(v) ? Number(v.toFixed(digits)) : NaN));
  const known = printed.filter((v) => !Number.isNaN(v));
  if (!better || new Set(known).size < 2) return values.map(() => null);
  return printed.map((v) => {
    if (Number.isNaN(v)) return null;
    const ahead = known.filter((o) => (better === "higher" ? o > v : o < v)).length;
    return ahead < 3 ? ahead + 1 : null;
  });
}

/** The text of a cell: a value, or the range of a time that does not compare. */
function cellText(s, key) {
  const { digits } = measure(key);
  if (Number.isNaN(s.value)) return "–";
  const [low, high] = [shown(s.low, digits), shown(s.high, digits)];
  return s.comparable || low === high ? shown(s.value, digits) : `${low}–${high}`;
}

/** Rows of texts as a file; a spreadsheet takes every cell for text or a number. */
function saveCsv(name, rows) {
  const cell = (v) => {
    const text = String(v ?? "");
    const safe = typeof v === "string" && /^\s*[=+\-@'\t\r\n]/.test(text) ? `'${text}` : text;
    return /[",\n\r]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
  };
  const link = h("a", { href: URL.createObjectURL(new Blob([rows.map((r) => r.map(cell).join(",")).join("\n") + "\n"], { type: "text/csv" })), download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const fileName = (what) => `${[state.dataset, what].join("-").toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "")}.csv`;
const plainNumber = (v) => (Number.isFinite(v) ? v : Number.isNaN(v) ? "" : v > 0 ? "inf" : "-inf");

// What papers print: one table of one paper at a time, method by scene, what `aw audit` found marked at its cells.
const UNITS = { psnr: "dB", ssim: "no unit", lpips: "no unit", gpu_hours: "hours", fps: "frames per second" };

function nothingReported() {
  const datasets = unique(DATA.reported.map((n) => n.dataset)).sort(byName);
  if (datasets.includes(state.dataset)) return "Nothing reported fits this choice.";
  return `No number of ${state.dataset} is printed anywhere we know of. Choose as dataset, to see what is: ${datasets.join(", ")}.`;
}

const sourceName = (table) => {
  const about = Object.hasOwn(DATA.sources, table) ? DATA.sources[table] : null;
  return about?.caption ? `${about.caption} (${table})` : table;
};

function drawReported() {
  const section = $("others");
  section.hidden = !DATA.reported.length || !state.reported;
  if (section.hidden) return;
  const here = DATA.reported.filter((n) => n.dataset === state.dataset);
  // The largest table first: it compares most methods.
  const size = (table) => here.filter((n) => n.table === table).length;
  const tables = unique(here.map((n) => n.table)).sort((a, b) => size(b) - size(a) || byName(a, b));
  fill($("source"), tables.map((t) => [t, sourceName(t)]), $("source").value);
  const inTable = here.filter((n) => n.table === $("source").value);
  const order = ["psnr", "ssim", "lpips"];
  const place = (m) => (order.includes(m) ? order.indexOf(m) : order.length);
  const key = (n) => JSON.stringify([n.metric, n.variant]);
  const metrics = unique(inTable.map(key)).sort((a, b) => place(JSON.parse(a)[0]) - place(JSON.parse(b)[0]) || byName(a, b));
  fill($("source-metric"), metrics.map((k) => [k, metricName(k)]), $("source-metric").value);
  for (const id of ["source", "source-metric"]) $(id).parentElement.hidden = !tables.length;
  const chosen = inTable.filter((n) => key(n) === $("source-metric").value);
  const scenes = unique(chosen.map((n) => n.scene)).sort((a, b) => (b === "mean") - (a === "mean") || byName(a, b));
  const rows = new Map();
  for (const n of chosen) {
    const id = JSON.stringify([n.method, n.setting]);
    if (!rows.has(id)) rows.set(id, { title: `${n.method} ${n.setting}`, first: n, cells: {} });
    (rows.get(id).cells[`s:${n.scene}`] ??= []).push(n);
  }
  drawReportedTable([...rows.values()].filter((row) => asked(row.first.method)), scenes, tables);
}

function metricName(key) {
  if (!key) return "";
  const [metric, variant] = JSON.parse(key);
  const label = Object.hasOwn(PLAIN, metric) ? PLAIN[metric] : measure(metric).label;
  // What a paper leaves open is said: for memory the unit, for SSIM and LPIPS the variant.
  const unit = metric === "psnr" ? "dB" : variant !== "unknown" ? variant : Object.hasOwn(UNITS, metric) && !["ssim", "lpips"].includes(metric) ? UNITS[metric] : metric === "memory" ? "unit not stated" : "variant not stated";
  return `${label}, ${unit}`;
}
const PLAIN = { psnr: "PSNR", ssim: "SSIM", lpips: "LPIPS" };

function drawReportedTable(rows, scenes, tables) {
  const key = $("source-metric").value;
  const metric = key ? JSON.parse(key)[0] : "";
  const better = measure(metric === "lpips" ? "lpips_alex" : metric).better;
  const value = (row, scene) => number(row.cells[`s:${scene}`]?.[0].value);
  const columns = [
    { key: "method", label: "Method", name: true, sort: (row) => row.title },
    ...scenes.map((s) => ({ key: `s:${s}`, label: s, down: better === "higher", arrow: { higher: " ↑", lower: " ↓" }[better] ?? "", sort: (row) => value(row, s) })),
  ];
  const fallback = { key: columns[1]?.key ?? "method", down: better === "higher" };
  const listed = sorted(rows, columns, "others-table", fallback);
  const marks = new Map(); // finding -> its number on the page
  const body = h("tbody", {}, ...listed.map((row) => h("tr", { "data-group": row.title },
    h("th", { scope: "row", class: "name" }, row.first.method, row.first.setting ? h("small", {}, row.first.setting) : null),
    ...scenes.map((s) => reportedCell(row.cells[`s:${s}`] ?? [], marks)))));
  const focus = focusOf($("others-table"));
  $("others-table").replaceChildren(head(columns, "others-table", fallback, drawReported), body);
  focus();
  $("others-table").parentElement.hidden = !listed.length;
  $("others-csv").hidden = !listed.length;
  $("others-csv").onclick = () => saveCsv(fileName(`reported-${metric}`), [["source", "table", "dataset", "metric", "variant", "method", "setting", ...scenes],
    ...listed.map((row) => ["reported", row.first.table, row.first.dataset, metric, row.first.variant, row.first.method, row.first.setting, ...scenes.map((s) => row.cells[`s:${s}`]?.[0].value ?? "")])]);
  $("findings").replaceChildren(...[...marks.keys()].map((f) => h("li", { value: marks.get(f) }, h("strong", {}, f.kind), `: ${f.text}`)));
  const about = Object.hasOwn(DATA.sources, $("source").value) ? DATA.sources[$("source").value] : null;
  const said = $("source-said");
  if (!listed.length) said.textContent = tables.length ? "Nothing reported fits this choice." : nothingReported();
  else {
    const paper = about?.title ? (about.url ? h("a", { href: about.url, rel: "noreferrer noopener" }, about.title) : h("cite", {}, about.title)) : "Paper not stated";
    said.replaceChildren(paper, about?.venue ? `, ${about.venue}` : "", `. Table ${$("source").value}; ${metricName(key)}; ${listed.length} methods.`,
      marks.size ? ` ${marks.size} of its numbers' findings by aw audit are marked and listed below; they are questions, not verdicts.` : " aw audit finds nothing in these numbers.");
  }
}

/** A printed number with the audit's findings about it as numbered marks. */
function reportedCell(numbers, marks) {
  if (!numbers.length) return h("td", { class: "none" }, "–");
  const found = unique(numbers.flatMap((n) => FINDINGS.get(n.where) ?? []));
  for (const f of found) if (!marks.has(f)) marks.set(f, marks.size + 1);
  const about = found.map((f) => `${f.kind}: ${f.text}`).join("\n");
  return h("td", { class: found.length ? "asked" : null, title: about || null }, unique(numbers.map((n) => n.printed)).join(" / "),
    found.length ? h("sup", { class: "flag", "aria-label": `, finding ${found.map((f) => marks.get(f)).join(", ")}` }, `⚠${found.map((f) => marks.get(f)).join(",")}`) : null);
}

const FINDINGS = (() => {
  const by = new Map();
  for (const f of DATA.findings) for (const where of f.where) by.set(where, [...(by.get(where) ?? []), f]);
  return by;
})();

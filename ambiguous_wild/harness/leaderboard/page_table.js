// Tables: headers that sort, dots for seeds, a row that opens to its runs.

/** Sorted rows: what is missing goes last whichever way, ties go by name. */
function sorted(rows, columns, name, fallback) {
  const { key, down } = state.sort[name] ?? fallback;
  const column = columns.find((c) => c.key === key) ?? columns[0];
  return [...rows].sort((a, b) => {
    const [x, y] = [column.sort(a), column.sort(b)];
    if (typeof x === "string") return (down ? -1 : 1) * byName(x, y) || byName(a.title, b.title);
    if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y) || byName(a.title, b.title);
    return (x === y ? 0 : (down ? -1 : 1) * (x < y ? -1 : 1)) || byName(a.title, b.title);
  });
}

function head(columns, name, fallback, redraw) {
  const { key, down } = state.sort[name] ?? fallback;
  return h("thead", {}, h("tr", {}, ...columns.map((c) => {
    const active = c.key === key;
    const press = () => {
      state.sort[name] = { key: c.key, down: active ? !down : Boolean(c.down) };
      redraw();
      document.querySelector(`#${name} thead button[data-key="${CSS.escape(c.key)}"]`)?.focus();
    };
    const button = h("button", { type: "button", "data-key": c.key, onclick: press, title: c.title ?? `Sort by ${c.label}` },
      h("span", { class: "way", "data-way": c.arrow ?? "" }, c.label), c.small ? h("small", {}, c.small) : null);
    return h("th", { scope: "col", class: c.name ? "name" : null, "aria-sort": active ? (down ? "descending" : "ascending") : "none" }, button);
  })));
}

/** Seeds as dots between the least and the greatest of the column. */
function dots(seeds, low, high) {
  const at = (v) => 3 + 50 * (high > low ? (v - low) / (high - low) : 0.5);
  const marks = seeds.filter(Number.isFinite).map((v) => svg("circle", { cx: at(v).toFixed(1), cy: 4, r: 2.4, "fill-opacity": 0.65 }));
  return svg("svg", { class: "dots", width: 56, height: 8, viewBox: "0 0 56 8", "aria-hidden": "true" },
    svg("line", { x1: 3, x2: 53, y1: 4, y2: 4 }), ...marks);
}

function cell(s, key, rank, low, high, many) {
  const { digits } = measure(key);
  if (Number.isNaN(s.value)) return h("td", { class: "none" }, "–");
  const quality = !COSTS.includes(key);
  const title = s.seeds.length > 1 ? `seeds: ${s.seeds.map((v) => shown(v, digits)).join(", ")}` : null;
  const deviation = quality && !Number.isNaN(s.spread) ? h("small", {}, `±${shown(s.spread, digits)}`) : null;
  const place = rank ? h("sup", { "aria-label": `, rank ${rank}` }, String(rank)) : null;
  const marks = quality && many && s.seeds.length > 1 ? dots(s.seeds, low, high) : null;
  const below = deviation || marks ? h("div", { class: "spread" }, deviation, marks) : null;
  return h("td", { title, "data-rank": rank }, shown(s.value, digits), place, below);
}

function measuredColumns(runs, scenes) {
  const arrow = (key) => ({ higher: " ↑", lower: " ↓" })[measure(key).better] ?? "";
  const column = (key, label, of, small) => ({
    key: small ? `${key}:${small}` : key, metric: key, label, small, arrow: arrow(key), down: measure(key).better === "higher", of,
  });
  const present = (key) => runs.some((r) => !Number.isNaN(valueOf(r, key)));
  const cost = COSTS.filter(present).map((k) => column(k, measure(k).label, scenes));
  if (state.metric) {
    const label = measure(state.metric).label;
    const each = scenes.length > 1 ? scenes.map((s) => column(state.metric, label, [s], s)) : [];
    return [column(state.metric, label, scenes, each.length ? "mean" : ""), ...each, ...cost];
  }
  const quality = DATA.order.filter((k) => runs.some((r) => Object.hasOwn(r.quality, k)));
  return [...quality.map((k) => column(k, measure(k).label, scenes)), ...cost];
}

function drawMeasured() {
  const runs = runsOf(state.dataset).filter((r) => !state.scene || r.scene === state.scene);
  const scenes = state.scene ? [state.scene] : scenesOf(state.dataset);
  const found = groups(state.dataset).map((g) => ({ ...g, runs: g.runs.filter((r) => scenes.includes(r.scene)) })).filter((g) => g.runs.length);
  const every = measuredColumns(runs, scenes);
  // a mean over scenes of which one lacks the metric is missing for everybody: a note says so, not an empty column
  const filled = (c) => found.some((g) => !Number.isNaN(summary(g, c.metric, c.of).value));
  const measuredOnes = every.some(filled) ? every.filter((c) => c.small || filled(c)) : every;
  const empty = every.filter((c) => !measuredOnes.includes(c));
  const rows = found.map((g) => ({ group: g, title: `${g.method} ${g.about}`, cells: measuredOnes.map((c) => summary(g, c.metric, c.of)) }));
  const seeds = (row) => unique(row.group.runs.map((r) => r.seed)).length;
  const columns = [
    { key: "method", label: "Method", name: true, sort: (row) => row.title },
    ...measuredOnes.map((c, i) => ({ ...c, sort: (row) => row.cells[i].value })),
    { key: "seeds", label: "Seeds", down: true, sort: seeds },
  ];
  const first = columns[1];
  const fallback = { key: first.key, down: Boolean(first.down) };
  const ranked = measuredOnes.map((c, i) => ranks(rows.map((row) => (isOracle(row.group) ? NaN : row.cells[i].value)), c.metric));
  const ends = measuredOnes.map((_, i) => rows.flatMap((row) => row.cells[i].seeds).filter(Number.isFinite));
  const limits = ends.map((v) => [Math.min(...v), Math.max(...v)]);
  const body = h("tbody");
  for (const row of sorted(rows, columns, "table", fallback)) {
    const at = rows.indexOf(row);
    const cells = row.cells.map((s, i) => cell(s, measuredOnes[i].metric, ranked[i][at], ...limits[i], true));
    const covered = unique(row.group.runs.map((r) => r.scene)).length;
    const part = covered < scenes.length ? h("small", {}, ` of ${covered}/${scenes.length} scenes`) : null;
    const line = h("tr", {}, nameCell(row.group, columns.length), ...cells, h("td", {}, String(seeds(row)), part));
    body.append(line);
  }
  $("table").replaceChildren(head(columns, "table", fallback, drawMeasured), body);
  const where = state.scene || (scenes.length === 1 ? scenes[0] : `the mean over ${scenes.length} scenes`);
  $("said").textContent = rows.length ? `${rows.length} of ${unique(runsOf(state.dataset).map(groupKey)).length} entries, ${where}` : "Nothing measured fits this choice.";
  $("table").parentElement.hidden = !rows.length;
  drawNotes(runs, found, scenes, empty);
  remember();
}

function nameCell(group, width) {
  const open = h("button", { type: "button", class: "open", "aria-expanded": "false", title: "Runs, hashes, commands" }, group.method);
  open.addEventListener("click", () => {
    const line = open.closest("tr");
    const isOpen = open.getAttribute("aria-expanded") === "true";
    open.setAttribute("aria-expanded", String(!isOpen));
    if (isOpen) line.nextElementSibling.remove();
    else line.after(h("tr", { class: "more" }, h("td", { colspan: width }, h("div", { class: "runs" }, ...group.runs.map(oneRun)))));
  });
  const oracle = isOracle(group) ? h("span", { class: "badge", title: "shown exact masks or clean photos" }, "oracle (not ranked)") : null;
  return h("th", { scope: "row", class: "name" }, open, oracle, h("small", {}, group.about));
}

function oneRun(run) {
  const values = DATA.order.filter((k) => Object.hasOwn(run.quality, k)).map((k) => `${measure(k).label} ${shown(valueOf(run, k), measure(k).digits)}`);
  const checked = run.checked === "photos" ? "metrics computed again from its renders" : run.checked === "psnr" ? "PSNR computed again from its renders" : "files and hashes checked, the scene was not at hand";
  const code = h("code", {}, run.reproduce);
  return h("div", { class: "run" },
    h("p", {}, h("strong", {}, `${run.scene}, seed ${run.seed}`), `: ${values.join(", ")}`),
    h("p", { class: "small" }, `${run.images} test images; ${checked}; ${run.device}, ${run.hardware}; version ${run.version}; configuration ${run.config_hash.slice(0, 12)}, scene ${run.scene_hash.slice(0, 12)}, result ${run.result_hash.slice(0, 12)}${run.source ? `, its file ${run.source.slice(0, 12)}` : ""}${run.code_hash ? `, code ${run.code_hash.slice(0, 12)}` : ""}`),
    run.view ? h("p", {}, h("a", { href: run.view }, "Fly through the model")) : null,
    h("div", { class: "row" }, code, h("button", { type: "button", class: "copy", "aria-label": "Copy the command", onclick: (e) => copy(code, e.currentTarget) }, "Copy")));
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

function drawNotes(runs, found, scenes, empty) {
  const notes = [];
  const missing = unique(runs.flatMap((r) => r.missing)).filter((k) => !runs.some((r) => Object.hasOwn(r.quality, k)));
  if (missing.length) notes.push(`Not measured in any of these runs: ${missing.map((k) => measure(k).label).join(", ")}.`);
  if (empty.length) notes.push(`No mean over all scenes, because some have nothing to measure it on: ${empty.map((c) => c.label).join(", ")}. Choose a scene, or the metric, to see it.`);
  for (const g of found) {
    const lacking = scenes.filter((s) => !g.runs.some((r) => r.scene === s));
    if (lacking.length) notes.push(`${g.method} (${g.about}) has no run on ${lacking.join(", ")}: no mean.`);
  }
  const machines = unique(runs.map((r) => r.hardware)).sort(byName);
  if (machines.length > 1) notes.push(`Times are of different machines (${machines.join("; ")}) and do not compare across them.`);
  const files = runs.filter((r) => r.checked === "files").length;
  if (files) notes.push(`${files} of ${runs.length} runs were taken in without their scene at hand: their metrics were not computed again.`);
  $("notes").replaceChildren(...notes.map((n) => h("li", {}, n)));
}

function nothingReported() {
  const datasets = unique(DATA.reported.map((n) => n.dataset)).sort(byName);
  if (datasets.includes(state.dataset)) return "Nothing reported fits this choice.";
  return `No number of ${state.dataset} is printed anywhere we know of. Choose as dataset, to see what is: ${datasets.join(", ")}.`;
}

/** What papers print, one row a method, scene and table: its own table, so that nothing is ranked together. */
function drawReported() {
  const section = $("others");
  section.hidden = !DATA.reported.length || !state.reported;
  if (section.hidden) return;
  const asked = state.method.trim().toLowerCase();
  const metricOf = (n) => JSON.stringify([n.metric, n.variant]);
  const fits = DATA.reported.filter((n) => n.dataset === state.dataset && (!state.scene || n.scene === state.scene)
    && `${n.method} ${n.setting}`.toLowerCase().includes(asked) && (!state.metric || [state.metric, state.metric.split("_")[0]].includes(n.metric)));
  const lines = new Map();
  for (const n of fits) {
    const key = JSON.stringify([n.method, n.setting, n.scene, n.table]);
    if (!lines.has(key)) lines.set(key, { title: `${n.method} ${n.setting} ${n.scene}`, first: n, cells: {} });
    lines.get(key).cells[metricOf(n)] = n;
  }
  const usual = ["psnr", "ssim", "lpips"];
  const rank = (key) => (usual.includes(JSON.parse(key)[0]) ? usual.indexOf(JSON.parse(key)[0]) : usual.length);
  const metrics = unique(fits.map(metricOf)).sort((a, b) => rank(a) - rank(b) || byName(a, b));
  const columns = [
    { key: "method", label: "Method", name: true, sort: (row) => `${row.first.method} ${row.first.setting}` },
    { key: "scene", label: "Scene", sort: (row) => row.first.scene },
    ...metrics.map((key) => {
      const [metric, variant] = JSON.parse(key);
      const better = measure(metric === "lpips" ? "lpips_alex" : metric).better;
      return { key, label: measure(metric).label.split(" ")[0], small: variant === "unknown" ? "variant unknown" : variant, down: better === "higher",
        arrow: { higher: " ↑", lower: " ↓" }[better] ?? "", sort: (row) => number(row.cells[key]?.value) };
    }),
    { key: "table", label: "Where", sort: (row) => row.first.table },
  ];
  const fallback = { key: columns.length > 3 ? columns[2].key : "method", down: Boolean(columns[2].down) };
  const body = h("tbody", {}, ...sorted([...lines.values()], columns, "others-table", fallback).map((row) => h("tr", {},
    h("th", { scope: "row", class: "name" }, row.first.method, " ", h("span", { class: "badge" }, "reported"), row.first.setting ? h("small", {}, row.first.setting) : null),
    h("td", {}, row.first.scene),
    ...metrics.map((key) => h("td", { class: row.cells[key] ? null : "none" }, row.cells[key]?.printed ?? "–")),
    h("td", {}, h("small", {}, row.first.table)))));
  $("others-table").replaceChildren(head(columns, "others-table", fallback, drawReported), body);
  $("others-table").parentElement.hidden = !lines.size;
  $("others-said").textContent = lines.size ? `${lines.size} rows` : nothingReported();
}

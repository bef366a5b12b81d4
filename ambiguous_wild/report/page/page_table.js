// The overview: headers that sort, dots for seeds, a row that opens to its runs.

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
      c.picture ?? null, h("span", { class: "way", "data-way": c.arrow ?? "" }, c.label), c.small ? h("small", {}, c.small) : null);
    return h("th", { scope: "col", class: c.name ? "name" : null, "aria-sort": active ? (down ? "descending" : "ascending") : "none" }, button);
  })));
}

const arrow = (key) => ({ higher: " ↑", lower: " ↓" })[measure(key).better] ?? "";

/** Seeds as dots between the least and the greatest of the column. */
function dots(seeds, low, high) {
  const at = (v) => 3 + 50 * (high > low ? (v - low) / (high - low) : 0.5);
  const marks = seeds.filter(Number.isFinite).map((v) => svg("circle", { cx: at(v).toFixed(1), cy: 4, r: 2.4, "fill-opacity": 0.65 }));
  return svg("svg", { class: "dots", width: 56, height: 8, viewBox: "0 0 56 8", "aria-hidden": "true" },
    svg("line", { x1: 3, x2: 53, y1: 4, y2: 4 }), ...marks);
}

/** What a cell holds: value or range, rank, deviation and seeds. */
function inside(s, key, rank, low, high) {
  const { digits } = measure(key);
  const quality = !COSTS.includes(key);
  const deviation = quality && !Number.isNaN(s.spread) ? h("small", {}, `±${shown(s.spread, digits)}`) : null;
  const place = rank ? h("sup", { "aria-label": `, rank ${rank}` }, String(rank)) : null;
  const marks = quality && s.seeds.length > 1 ? dots(s.seeds, low, high) : null;
  const below = deviation || marks ? h("div", { class: "spread" }, deviation, marks) : null;
  return [cellText(s, key), place, below].filter(Boolean);
}

function cell(s, key, rank, low, high) {
  if (Number.isNaN(s.value)) return h("td", { class: "none" }, "–");
  const { digits } = measure(key);
  const title = !s.comparable ? "a range, not ranked: see the notes" : s.seeds.length > 1 ? `seeds: ${s.seeds.map((v) => shown(v, digits)).join(", ")}` : null;
  return h("td", { title, "data-rank": rank, class: s.comparable ? null : "range" }, ...inside(s, key, rank, low, high));
}

function measuredColumns(runs, scenes) {
  const present = (key) => runs.some((r) => !Number.isNaN(valueOf(r, key)));
  const all = [...DATA.order.filter((k) => runs.some((r) => Object.hasOwn(r.quality, k))), ...COSTS.filter(present)];
  const keys = state.metric === ALL ? all : all.filter((k) => MAIN.includes(k) || k === state.metric);
  return keys.map((key) => {
    const over = definedScenes(key, scenes).length;
    return { key, label: measure(key).label, arrow: arrow(key), down: measure(key).better === "higher", small: over && over < scenes.length ? `${over} of ${scenes.length} scenes` : "" };
  });
}

/** The groups with runs on the ticked scenes, their summaries and ranks by column; the search takes nothing away. */
function overview() {
  const scenes = chosenScenes();
  const runs = runsOf(state.dataset).filter((r) => scenes.includes(r.scene));
  const found = groups(state.dataset).map((g) => ({ ...g, runs: g.runs.filter((r) => scenes.includes(r.scene)) })).filter((g) => g.runs.length);
  const every = measuredColumns(runs, scenes);
  const filled = (c) => found.some((g) => !Number.isNaN(summary(g, c.key, scenes).value));
  const columns = every.some(filled) ? every.filter(filled) : every;
  const rows = found.map((g) => ({ group: g, title: `${g.method} ${g.about}`, cells: columns.map((c) => summary(g, c.key, scenes)) }));
  const ranked = columns.map((c, i) => ranks(rankable(found, rows.map((row) => row.cells[i]), c.key), c.key));
  rows.forEach((row, at) => { row.ranks = ranked.map((r) => r[at]); });
  return { scenes, runs, found, columns, rows, empty: every.filter((c) => !columns.includes(c)) };
}

function drawMeasured() {
  const { scenes, runs, found, columns: measuredOnes, rows: all, empty } = overview();
  const rows = all.filter((row) => asked(row.group.method));
  const seeds = (row) => unique(row.group.runs.map((r) => r.seed)).length;
  const columns = [
    { key: "method", label: "Method", name: true, sort: (row) => row.title },
    ...measuredOnes.map((c, i) => ({ ...c, sort: (row) => row.cells[i].value })),
    { key: "seeds", label: "Seeds", down: true, sort: seeds },
  ];
  const best = columns.find((c) => c.key === state.metric) ?? columns[1];
  const fallback = { key: best.key, down: Boolean(best.down) };
  const ends = measuredOnes.map((_, i) => all.flatMap((row) => row.cells[i].seeds).filter(Number.isFinite));
  const limits = ends.map((v) => [Math.min(...v), Math.max(...v)]);
  const body = h("tbody");
  for (const row of sorted(rows, columns, "table", fallback)) {
    const cells = row.cells.map((s, i) => cell(s, measuredOnes[i].key, row.ranks[i], ...limits[i]));
    const covered = unique(row.group.runs.map((r) => r.scene)).length;
    const part = covered < scenes.length ? h("small", {}, ` on ${covered} of ${scenes.length} scenes`) : null;
    body.append(h("tr", { "data-group": row.group.key }, nameCell(row.group), ...cells, h("td", {}, String(seeds(row)), part)));
    if (state.open.has(row.group.key)) body.append(opened(row.group.runs, columns.length));
  }
  const focus = focusOf($("table"));
  $("table").replaceChildren(head(columns, "table", fallback, drawMeasured), body);
  focus();
  const where = scenes.length === 1 ? scenes[0] : `mean over ${scenes.length} scenes`;
  $("said").textContent = rows.length ? `${rows.length} of ${all.length} entries, ${where}` : scenes.length ? "Nothing measured fits this choice." : "No scene is ticked.";
  $("table").parentElement.hidden = !rows.length;
  $("table-csv").hidden = !rows.length;
  $("table-csv").onclick = () => saveCsv(fileName("overview"), csvRows(sorted(rows, columns, "table", fallback), measuredOnes, scenes));
  drawNotes(runs, found, scenes, empty, measuredOnes);
  remember();
}

/** Puts the focus back on what had it in a table that is drawn again. */
function focusOf(table) {
  const had = document.activeElement;
  if (!table.contains(had)) return () => {};
  const row = had.closest("[data-group]")?.dataset.group, key = had.dataset.key ?? had.dataset.cell;
  return () => [...table.querySelectorAll("button")].find((b) => (b.dataset.key ?? b.dataset.cell) === key && b.closest("[data-group]")?.dataset.group === row)?.focus();
}

function csvRows(rows, columns, scenes) {
  const head = ["dataset", "scenes", "method", "setting", "options", "reference", "seeds"];
  for (const c of columns) head.push(c.key, ...(isTime(c.key) ? [`${c.key}_low`, `${c.key}_high`, `${c.key}_comparable`] : [`${c.key}_std`]), `${c.key}_rank`);
  return [head, ...rows.map((row) => {
    const g = row.group;
    const line = [state.dataset, scenes.join(" "), g.method, g.setting, g.options, isReference(g) ? "yes" : "", unique(g.runs.map((r) => r.seed)).length];
    row.cells.forEach((s, i) => line.push(plainNumber(s.value), ...(isTime(columns[i].key) ? [plainNumber(s.low), plainNumber(s.high), s.comparable ? "yes" : "no"] : [plainNumber(s.spread)]), row.ranks[i] ?? ""));
    return line;
  })];
}

function referenceBadge(group) {
  return isReference(group) ? h("span", { class: "badge", title: "saw exact masks or clean photos" }, "reference, not ranked") : null;
}

function nameCell(group) {
  const isOpen = state.open.has(group.key);
  const press = () => {
    if (isOpen) state.open.delete(group.key);
    else state.open.add(group.key);
    drawMeasured();
  };
  const open = h("button", { type: "button", class: "open", "data-key": "open", "aria-expanded": String(isOpen), title: "Runs, hashes, commands", onclick: press }, group.method);
  return h("th", { scope: "row", class: "name" }, open, referenceBadge(group), h("small", {}, group.about));
}

function drawNotes(runs, found, scenes, empty, columns) {
  const notes = [];
  const missing = unique(runs.flatMap((r) => r.missing)).filter((k) => !DATA.partial.includes(k) && !runs.some((r) => Object.hasOwn(r.quality, k)));
  if (missing.length) notes.push(`Not measured in any of these runs: ${missing.map((k) => measure(k).label).join(", ")}.`);
  if (empty.length) notes.push(`No mean is shown where a value is missing: ${empty.map((c) => c.label).join(", ")}.`);
  const left = new Map();
  for (const c of columns) {
    const out = scenes.filter((s) => !definedScenes(c.key, scenes).includes(s)).join(", ");
    if (out) left.set(out, [...(left.get(out) ?? []), c.label]);
  }
  for (const [out, labels] of left) notes.push(`Undefined for ${out} and left out of the mean: ${labels.join(", ")}.`);
  for (const g of found) {
    const lacking = scenes.filter((s) => !g.runs.some((r) => r.scene === s));
    if (lacking.length) notes.push(`${g.method} (${g.about}) has no run on ${lacking.join(", ")}: no mean.`);
  }
  for (const c of columns) {
    for (const g of found) {
      const { cells, value } = summary(g, c.key, scenes);
      if (!Number.isNaN(value) && cells.finite < cells.all) notes.push(`${c.label} of ${g.method} (${g.about}): mean of ${cells.finite} of ${cells.all} runs, the others are not finite.`);
    }
  }
  if (unique(found.map((g) => g.setting)).length > 1) notes.push("Entries differ in length, effects or protocol (under each name): a rank may be due to this and not to the method.");
  const timed = columns.filter((c) => isTime(c.key)).map((c) => c.label).join(", ");
  const shared = runs.filter((r) => r.alone === false).length, unknown = runs.filter((r) => r.alone === null).length;
  if (timed && (shared || unknown)) {
    const why = [shared ? `${shared} of ${runs.length} runs shared the machine with other work` : "", unknown ? `the load during ${unknown} of ${runs.length} runs was not recorded` : ""].filter(Boolean).join("; ");
    notes.push(`Shown as ranges over runs and not ranked: ${timed}, because ${why}.`);
  }
  const machines = unique(runs.map((r) => r.hardware)).sort(byName);
  if (machines.length > 1) notes.push(`Times are of different machines (${machines.join("; ")}) and are not ranked.`);
  const files = runs.filter((r) => r.checked === "files").length;
  if (files) notes.push(`${files} of ${runs.length} runs were taken in without their scene at hand: their metrics were not computed again.`);
  $("notes").replaceChildren(...notes.map((n) => h("li", {}, n)));
}

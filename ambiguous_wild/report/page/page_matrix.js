// Method by scene for one metric; a cell opens to its seeds, renders and commands.

const matrixKey = () => (state.metric !== ALL && state.metric) || DATA.order.find((k) => runsOf(state.dataset).some((r) => Object.hasOwn(r.quality, k))) || "";
/** A picture that stands for a scene: a train photo, which shows its distractors, else a test photo. */
function sceneOf(name) {
  const found = DATA.images.filter((p) => p.dataset === state.dataset && p.scene === name && !p.method && p.kind !== "exact");
  return found.find((p) => p.kind === "train") ?? found[0];
}

/** What is known of a scene of a simulated suite: kind of ambiguity, place, share that distractors cover; or nothing. */
const factsOf = (name) => DATA.scenes[state.dataset]?.[name] ?? null;

/** The ticked scenes in groups by what is known of them, for means: [name, scenes]. */
function sceneGroups(scenes) {
  const by = $("group-by").value;
  const known = scenes.filter((s) => factsOf(s));
  return unique(known.map((s) => factsOf(s)[by])).map((value) => [value, known.filter((s) => factsOf(s)[by] === value)]);
}

function sceneTitle(name) {
  const f = factsOf(name);
  return f ? `${f.summary} (${f.place}); distractors cover ${f.covered ?? "?"} % of the photos; ambiguity by design: ${f.ambiguity}, measured: ${f.verdict}` : null;
}

function thumbnail(picture, alt) {
  return picture ? h("img", { class: "thumb", src: `images/${picture.file}`, alt, loading: "lazy" }) : null;
}

function drawMatrix() {
  const scenes = chosenScenes(), key = matrixKey();
  const found = groups(state.dataset).filter((g) => g.runs.some((r) => scenes.includes(r.scene)));
  const grouped = sceneGroups(scenes);
  $("group-by-choice").hidden = !grouped.length;
  const named = [...(scenes.length > 1 ? [["mean", scenes]] : []), ...grouped.filter(([, of]) => of.length > 1 && of.length < scenes.length), ...scenes.map((s) => [s, [s]])];
  const [names, parts] = [named.map(([name]) => name), named.map(([, of]) => of)];
  const cells = found.map((g) => parts.map((of) => summary(g, key, of)));
  const ranked = parts.map((_, i) => ranks(rankable(found, cells.map((row) => row[i]), key), key));
  const rows = found.map((g, at) => ({ group: g, title: `${g.method} ${g.about}`, cells: cells[at], ranks: ranked.map((r) => r[at]) }));
  const down = measure(key).better === "higher";
  const columns = [
    { key: "method", label: "Method", name: true, sort: (row) => row.title },
    ...names.map((name, i) => ({
      key: `${i}:${name}`, label: name, arrow: arrow(key), down, sort: (row) => row.cells[i].value,
      picture: parts[i].length === 1 ? thumbnail(sceneOf(parts[i][0]), "") : null,
      title: parts[i].length === 1 ? sceneTitle(name) : null,
      small: parts[i].length > 1 ? countedScenes(key, parts[i]) : "",
    })),
  ];
  const fallback = { key: columns[1]?.key ?? "method", down };
  const listed = sorted(rows.filter((row) => asked(row.group.method)), columns, "matrix", fallback);
  const body = h("tbody", {}, ...listed.map((row) => h("tr", { "data-group": row.group.key },
    h("th", { scope: "row", class: "name" }, row.group.method, referenceBadge(row.group), h("small", {}, row.group.about)),
    ...row.cells.map((s, i) => matrixCell(row.group, parts[i], s, key, row.ranks[i])))));
  const focus = focusOf($("matrix"));
  $("matrix").replaceChildren(head(columns, "matrix", fallback, drawMatrix), body);
  focus();
  $("matrix-title").textContent = `${measure(key).label} by scene`;
  $("by-scene").hidden = !rows.length;
  $("matrix-csv").onclick = () => saveCsv(fileName(`${key}-by-scene`), matrixCsv(listed, names, key));
  drawDrill(key);
}

/** How many of the scenes of a mean have a value, if not all. */
function countedScenes(key, scenes) {
  const defined = definedScenes(key, scenes).length;
  return defined < scenes.length ? `${defined} of ${scenes.length} scenes` : `${scenes.length} scenes`;
}

function matrixCell(group, of, s, key, rank) {
  if (of.length > 1 || Number.isNaN(s.value)) return cell(s, key, rank, 0, 0);
  const id = JSON.stringify([group.key, of[0]]);
  const press = () => {
    state.cell = state.cell === id ? null : id;
    drawMatrix();
    if (state.cell) $("drill").scrollIntoView({ block: "nearest" });
  };
  const { digits } = measure(key);
  const small = Number.isNaN(s.spread) || COSTS.includes(key) ? null : h("small", {}, `±${shown(s.spread, digits)}`);
  const button = h("button", { type: "button", class: "cell", "data-cell": of[0], "aria-expanded": String(state.cell === id), "aria-label": `${group.method} on ${of[0]}: ${cellText(s, key)}${rank ? `, rank ${rank}` : ""}`, onclick: press },
    cellText(s, key), rank ? h("sup", {}, String(rank)) : null, small);
  return h("td", { "data-rank": rank, class: s.comparable ? null : "range" }, button);
}

function matrixCsv(rows, names, key) {
  return [["dataset", "metric", "method", "setting", "options", "reference", ...names],
    ...rows.map((row) => [state.dataset, key, row.group.method, row.group.setting, row.group.options, isReference(row.group) ? "yes" : "", ...row.cells.map((s) => plainNumber(s.value))])];
}

/** What stands behind a cell: every seed, the renders, and the way into the comparison. */
function drawDrill(key) {
  const [groupId, scene] = state.cell ? JSON.parse(state.cell) : ["", ""];
  const group = groups(state.dataset).find((g) => g.key === groupId);
  const runs = group?.runs.filter((r) => r.scene === scene).sort((a, b) => a.seed - b.seed) ?? [];
  $("drill").hidden = !runs.length || !chosenScenes().includes(scene) || !asked(group.method);
  if ($("drill").hidden) return;
  const { digits, label } = measure(key);
  const found = DATA.images.filter((p) => p.dataset === state.dataset && p.scene === scene && p.kind === "test" && p.method && pictureKey(p) === groupId);
  const compare = (picture) => {
    showPicture(scene, picture.image, groupId);
    $("compare").scrollIntoView({ block: "start" });
    $("left").focus({ preventScroll: true });
  };
  const close = () => {
    state.cell = null;
    drawMatrix();
    [...document.querySelectorAll("#matrix [data-cell]")].find((b) => b.dataset.cell === scene && b.closest("tr").dataset.group === groupId)?.focus();
  };
  $("drill").replaceChildren(
    h("div", { class: "title" }, h("h3", {}, `${group.method} on ${scene}`), h("button", { type: "button", id: "drill-close", onclick: close }, "Close")),
    h("p", { class: "small" }, `${label}: ${runs.map((r) => `seed ${r.seed} ${shown(valueOf(r, key), digits)}`).join(", ")}`),
    h("div", { class: "thumbs" }, ...found.map((p) => h("button", { type: "button", class: "view", onclick: () => compare(p) },
      thumbnail(p, ""), `${p.image}${p.psnr === null ? "" : `, ${shown(number(p.psnr), 2)} dB`}`))),
    h("div", { class: "runs" }, ...runs.map(oneRun)));
}

// Quality against cost: a point a method, seeds as error bars, the Pareto front dashed.
const COLOURS = ["#0b7fc4", "#e07a1f", "#2a9d63", "#c23b7e", "#7a5fd0", "#a58a00", "#00a0a8", "#b5452c"];
const SHAPES = [
  (x, y) => svg("circle", { cx: x, cy: y, r: 6 }),
  (x, y) => svg("rect", { x: x - 5.5, y: y - 5.5, width: 11, height: 11 }),
  (x, y) => svg("path", { d: `M${x} ${y - 7}L${x + 6.5} ${y + 5}H${x - 6.5}Z` }),
  (x, y) => svg("path", { d: `M${x} ${y - 7.5}L${x + 7} ${y}L${x} ${y + 7.5}L${x - 7} ${y}Z` }),
];

/** Round steps over [low, high]; on a logarithmic axis 1, 2, 5 of every decade. */
function ticks(low, high, log) {
  const found = [];
  if (log) {
    for (let e = Math.floor(Math.log10(low)); e <= Math.log10(high); e++)
      for (const f of [1, 2, 5]) if (f * 10 ** e >= low && f * 10 ** e <= high) found.push(f * 10 ** e);
    if (found.length > 1) return found;
    found.length = 0;
  }
  const raw = (high - low) / 5 || 1;
  const unit = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((f) => f * unit).find((s) => s >= raw);
  for (let v = Math.ceil(low / step) * step; v <= high + step * 1e-6; v += step) found.push(Number(v.toPrecision(12)));
  return found;
}

function axis(values, log) {
  let [low, high] = [Math.min(...values), Math.max(...values)];
  if (log) return [low / 1.25, high * 1.4];
  const pad = (high - low) * 0.12 || Math.abs(high) * 0.1 || 1;
  return [low - pad, high + pad];
}

/** A colour and a shape for every method of the page: no filter changes them. */
const look = (() => {
  const names = unique(DATA.runs.map((r) => r.method)).sort(byName);
  const settings = (method) => unique(DATA.runs.filter((r) => r.method === method).map(groupKey)).sort(byName);
  return (group) => {
    const at = names.indexOf(group.method), twin = settings(group.method).indexOf(group.key);
    return { colour: COLOURS[at % COLOURS.length], shape: SHAPES[(at + Math.floor(at / COLOURS.length) + twin) % SHAPES.length] };
  };
})();

function drawPlot() {
  const scenes = chosenScenes();
  const [kx, ky] = [$("plot-x").value, $("plot-y").value];
  const every = groups(state.dataset).sort((a, b) => byName(a.method + a.about, b.method + b.about))
    .map((g) => ({ group: g, x: summary(g, kx, scenes), y: summary(g, ky, scenes) }))
    .filter((p) => Number.isFinite(p.x.value) && Number.isFinite(p.y.value));
  const points = every.filter((p) => asked(p.group.method));
  $("cost").hidden = !DATA.runs.some((r) => r.dataset === state.dataset);
  if (!points.length) {
    $("plot").replaceChildren();
    $("plot-said").textContent = "No entry has both numbers here.";
    return;
  }
  const width = Math.min(Math.max($("plot").clientWidth, 300), 1100);
  const height = Math.round(Math.min(Math.max(width * 0.5, 300), 460));
  const [left, right, top, bottom] = [58, width - 16, 16, height - 48];
  const ends = (s) => [s.value, ...s.seeds, ...(s.comparable ? [] : [s.low, s.high]), ...(Number.isNaN(s.spread) ? [] : [s.value - s.spread, s.value + s.spread])].filter(Number.isFinite);
  const xs = points.flatMap((p) => ends(p.x)).filter((v) => v > 0);
  const log = xs.length > 0 && points.every((p) => p.x.value > 0) && Math.max(...xs) / Math.min(...xs) > 5;
  const [x0, x1] = axis(log ? xs : points.flatMap((p) => ends(p.x)), log);
  const [y0, y1] = axis(points.flatMap((p) => ends(p.y)), false);
  const fx = log ? Math.log : (v) => v;
  const px = (v) => Math.min(Math.max(left + ((right - left) * (fx(Math.max(v, log ? x0 : v)) - fx(x0))) / (fx(x1) - fx(x0)), left), right);
  const py = (v) => bottom - ((bottom - top) * (v - y0)) / (y1 - y0);
  const root = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-labelledby": "plot-said" });
  for (const v of ticks(x0, x1, log)) {
    root.append(svg("line", { class: "grid", x1: px(v), x2: px(v), y1: top, y2: bottom }),
      svg("text", { class: "axis", x: px(v), y: bottom + 17, "text-anchor": "middle" }, brief(v)));
  }
  for (const v of ticks(y0, y1, false)) {
    root.append(svg("line", { class: "grid", x1: left, x2: right, y1: py(v), y2: py(v) }),
      svg("text", { class: "axis", x: left - 7, y: py(v) + 4, "text-anchor": "end" }, brief(v)));
  }
  root.append(svg("text", { class: "axis", x: (left + right) / 2, y: height - 10, "text-anchor": "middle" }, `${measure(kx).label}${log ? " (logarithmic)" : ""}`),
    svg("text", { class: "axis", transform: `translate(14 ${(top + bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, measure(ky).label));
  // Of every entry, shown or not, whose numbers can be ranked.
  const kept = (key, side) => rankable(every.map((p) => p.group), every.map((p) => p[side]), key).map((v) => !Number.isNaN(v));
  const [openX, openY] = [kept(kx, "x"), kept(ky, "y")];
  const front = pareto(every.filter((_, i) => openX[i] && openY[i]), kx, ky);
  if (front.length > 1) {
    const path = front.map((p, i) => (i ? `H${px(p.x.value)}V${py(p.y.value)}` : `M${px(p.x.value)} ${py(p.y.value)}`)).join("");
    root.append(svg("path", { class: "front", d: path }));
  }
  const taken = points.map((p) => ({ x: px(p.x.value) - 9, y: py(p.y.value) - 9, w: 18, h: 18 }));
  points.forEach((p) => root.append(mark(p, px, py)));
  points.forEach((p) => root.append(label(p, px(p.x.value), py(p.y.value), taken, [left, right, top, bottom])));
  $("plot").replaceChildren(root);
  const many = points.some((p) => p.y.seeds.length > 1);
  const ranged = [[kx, "x"], [ky, "y"]].filter(([, side]) => every.some((p) => !p[side].comparable)).map(([key]) => measure(key).label);
  $("plot-said").textContent = `${measure(ky).label} against ${measure(kx).label}. `
    + (front.length ? `Pareto-optimal: ${front.map((p) => p.group.method).join(", ")}${front.length > 1 ? " (dashed)" : ""}.` : "No Pareto front: no two entries can be ranked in both.")
    + (ranged.length ? ` ${ranged.join(", ")}: the bars are ranges over runs, because not every run had the machine alone.` : "")
    + (many ? " Bars: sample deviation over seeds; faint dots: the seeds." : "");
}

const brief = (v) => (Math.abs(v) >= 10000 ? `${Number((v / 1000).toPrecision(4))}k` : String(Number(v.toPrecision(5))));

function mark(p, px, py) {
  const { colour, shape: draw } = look(p.group);
  const [x, y] = [px(p.x.value), py(p.y.value)];
  const of = svg("g", { stroke: colour, fill: colour }, svg("title", {}, `${p.group.method} (${p.group.about}): ${p.y.value.toPrecision(5)} at ${p.x.value.toPrecision(5)}`));
  p.y.seeds.forEach((v, s) => Number.isFinite(v) && Number.isFinite(p.x.seeds[s]) && p.y.seeds.length > 1
    && of.append(svg("circle", { class: "seed", cx: px(p.x.seeds[s]), cy: py(v), r: 2.5, stroke: "none" })));
  if (p.y.spread > 0) of.append(svg("line", { class: "bar", x1: x, x2: x, y1: py(p.y.value - p.y.spread), y2: py(p.y.value + p.y.spread) }));
  const [low, high] = p.x.comparable ? [p.x.value - p.x.spread, p.x.value + p.x.spread] : [p.x.low, p.x.high];
  if (high > low) of.append(svg("line", { class: p.x.comparable ? "bar" : "bar range", y1: y, y2: y, x1: px(low), x2: px(high) }));
  const shape = draw(x, y);
  shape.setAttribute("class", "point");
  of.append(shape);
  return of;
}

/** The name beside its point, where it hides no other name or point. */
function label(p, x, y, taken, [left, right, top, bottom]) {
  const name = p.group.method.length > 26 ? `${p.group.method.slice(0, 25)}…` : p.group.method;
  const w = name.length * 7.4 + 4;
  const places = [];
  for (const away of [0, 16, 32, 48])
    places.push([x + 9, y - 24 - away], [x - 9 - w, y - 24 - away], [x + 11, y - 8 + away], [x - 11 - w, y - 8 + away], [x - w / 2, y - 26 - away], [x - w / 2, y + 11 + away]);
  const free = ([bx, by]) => bx >= left && bx + w <= right + 10 && by >= top - 8 && by + 16 <= bottom
    && !taken.some((t) => bx < t.x + t.w && t.x < bx + w && by < t.y + t.h && t.y < by + 16);
  const [bx, by] = places.find(free) ?? [Math.min(Math.max(x + 11, left), right - w), y - 8];
  taken.push({ x: bx, y: by, w, h: 16 });
  return svg("text", { class: "name", x: bx + 2, y: by + 12 }, name);
}

/** Pareto-optimal points, from cheap to dear. */
function pareto(points, kx, ky) {
  const sx = measure(kx).better === "higher" ? -1 : 1;
  const sy = measure(ky).better === "lower" ? -1 : 1;
  const beats = (a, b) => sx * a.x.value <= sx * b.x.value && sy * a.y.value >= sy * b.y.value && (a.x.value !== b.x.value || a.y.value !== b.y.value);
  return points.filter((p) => !points.some((o) => beats(o, p))).sort((a, b) => sx * (a.x.value - b.x.value));
}

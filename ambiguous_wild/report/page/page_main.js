// What is chosen, and the way all of it comes together.

function fillFilters() {
  const own = measuredDatasets();
  const printed = unique(DATA.reported.map((n) => n.dataset)).filter((d) => !own.includes(d)).sort(byName);
  fill($("dataset"), [...own.map((d) => [d, d]), ...(state.reported ? printed.map((d) => [d, `${d} (reported)`]) : [])], state.dataset);
  state.dataset = $("dataset").value;
  const runs = runsOf(state.dataset);
  const metrics = [...DATA.order.filter((k) => runs.some((r) => Object.hasOwn(r.quality, k)))];
  const costs = ["reference_s", "train_s", "model_mb", "fps", "gaussians", "peak_rss_mb"].filter((k) => runs.some((r) => Object.hasOwn(r.cost, k)));
  fill($("metric"), [["", "main metrics"], [ALL, "all metrics"], ...[...metrics, ...costs].map((k) => [k, measure(k).label])], state.metric);
  state.metric = $("metric").value;
  fill($("plot-x"), costs.map((k) => [k, measure(k).label]), $("plot-x").value);
  fill($("plot-y"), metrics.map((k) => [k, measure(k).label]), metrics.includes(state.metric) ? state.metric : $("plot-y").value);
  fillScenes();
}

function fillScenes() {
  const scenes = scenesOf(state.dataset);
  for (const s of [...state.off]) if (!scenes.includes(s)) state.off.delete(s);
  const tick = (s) => {
    const box = h("input", { type: "checkbox", "data-scene": s, onchange: () => { if (box.checked) state.off.delete(s); else state.off.add(s); draw(); } });
    box.checked = !state.off.has(s);
    return h("label", { class: "scene" }, box, thumbnail(sceneOf(s), ""), h("span", {}, s));
  };
  const had = document.activeElement?.dataset?.scene;
  $("scenes").hidden = scenes.length < 1;
  $("scene-ticks").replaceChildren(...scenes.map(tick));
  if (had) [...$("scene-ticks").querySelectorAll("input")].find((b) => b.dataset.scene === had)?.focus();
  $("scenes-said").textContent = `Scenes: ${scenes.length - state.off.size} of ${scenes.length}`;
}

function draw() {
  fillFilters();
  $("measured").hidden = !runsOf(state.dataset).length;
  drawMeasured();
  drawMatrix();
  drawPlot();
  fillPair();
  drawReported();
}

/** The choice goes into the address, so that it can be sent round; what comes back is checked where it is used. */
function remember() {
  const words = new URLSearchParams();
  for (const key of ["dataset", "metric", "method"]) if (state[key]) words.set(key, state[key]);
  for (const scene of [...state.off].sort(byName)) words.append("without", scene);
  if (!state.reported) words.set("reported", "no");
  if (state.sort.table) words.set("sort", (state.sort.table.down ? "-" : "") + state.sort.table.key);
  try {
    history.replaceState(null, "", words.size ? `#${words}` : location.pathname + location.search);
  } catch {
    // Some browsers allow none from a file: then the address stays as it is.
  }
}

function recall() {
  const words = new URLSearchParams(location.hash.slice(1));
  for (const key of ["dataset", "metric", "method"]) state[key] = words.get(key) ?? "";
  state.off = new Set(words.getAll("without"));
  state.reported = words.get("reported") !== "no";
  const sort = words.get("sort");
  delete state.sort.table;
  if (sort) state.sort.table = { key: sort.replace(/^-/, ""), down: sort.startsWith("-") };
  $("method").value = state.method;
  $("reported").checked = state.reported;
}

function drawMethods() {
  const link = (url, text) => (url ? h("a", { href: url, rel: "noreferrer noopener" }, text) : null);
  $("methods").replaceChildren(...Object.keys(DATA.methods).sort(byName).map((name) => {
    const m = DATA.methods[name];
    const links = [link(m.paper_url, m.paper || "paper"), link(m.code_url, "code")].filter(Boolean);
    if (!m.paper_url && m.paper) links.unshift(m.paper);
    return h("li", {}, h("strong", {}, name), m.summary ? `: ${m.summary}` : ": a method of its own file", ...links.flatMap((l, i) => [i ? ", " : ". ", l]));
  }));
}

function start() {
  const methods = unique(DATA.runs.map((r) => r.method)).length;
  const counted = (n, what) => `${n} ${what}${n === 1 ? "" : "s"}`;
  const scenes = unique(DATA.runs.map((r) => JSON.stringify([r.dataset, r.scene]))).length;
  $("facts").textContent = `${counted(DATA.runs.length, "measured run")}: ${counted(methods, "method")}, ${counted(scenes, "scene")}`
    + (DATA.reported.length ? `; ${counted(DATA.reported.length, "reported number")} beside them` : "")
    + `. Published ${DATA.date} with ambiguous_wild ${DATA.version}.`;
  $("empty").hidden = DATA.runs.length > 0;
  $("filters").hidden = !DATA.runs.length && !DATA.reported.length;
  $("about").hidden = $("filters").hidden;
  $("reported-choice").hidden = !DATA.reported.length;
  $("files").append("Files: ", ...DATA.files.map((name) => h("a", { href: `data/${name}`, download: "" }, name)));
  drawMethods();
  recall();
  for (const key of ["dataset", "metric"]) $(key).addEventListener("change", () => { state[key] = $(key).value; if (key === "dataset") { state.open.clear(); state.cell = null; } draw(); });
  $("method").addEventListener("input", () => { state.method = $("method").value; draw(); });
  $("reported").addEventListener("change", () => { state.reported = $("reported").checked; draw(); });
  $("scenes-all").addEventListener("click", () => { state.off.clear(); draw(); });
  $("scenes-none").addEventListener("click", () => { state.off = new Set(scenesOf(state.dataset)); draw(); });
  window.addEventListener("hashchange", () => { recall(); draw(); });
  $("filters").addEventListener("submit", (event) => event.preventDefault());
  $("group-by").addEventListener("change", drawMatrix);
  for (const key of ["plot-x", "plot-y"]) $(key).addEventListener("change", drawPlot);
  for (const key of ["source", "source-metric"]) $(key).addEventListener("change", drawReported);
  startPair();
  draw();
  let width = $("plot").clientWidth;
  new ResizeObserver(() => { if ($("plot").clientWidth !== width) { width = $("plot").clientWidth; drawPlot(); } }).observe($("plot"));
  // What has the focus is scrolled to below the filters, whose height depends on how they wrap.
  const sticky = () => getComputedStyle($("filters")).position === "sticky" ? $("filters").offsetHeight : 0;
  new ResizeObserver(() => { document.documentElement.style.scrollPaddingTop = `${sticky() + 12}px`; }).observe($("filters"));
}

start();

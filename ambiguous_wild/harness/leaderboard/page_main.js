// What is chosen, the pair of images, and the way all of it comes together.
const PHOTO = "photo";

function fill(select, options, value) {
  select.replaceChildren(...options.map(([v, text]) => h("option", { value: v }, text)));
  select.value = options.some(([v]) => v === value) ? value : options[0]?.[0] ?? "";
}

function fillFilters() {
  const own = measuredDatasets();
  const printed = unique(DATA.reported.map((n) => n.dataset)).filter((d) => !own.includes(d)).sort(byName);
  fill($("dataset"), [...own.map((d) => [d, d]), ...(state.reported ? printed.map((d) => [d, `${d} (reported)`]) : [])], state.dataset);
  state.dataset = $("dataset").value;
  const reported = state.reported ? DATA.reported.filter((n) => n.dataset === state.dataset) : [];
  const scenes = unique([...scenesOf(state.dataset), ...reported.map((n) => n.scene).sort(byName)]);
  fill($("scene"), [["", "all scenes"], ...scenes.map((s) => [s, s])], state.scene);
  state.scene = $("scene").value;
  const runs = runsOf(state.dataset);
  const metrics = [...DATA.order.filter((k) => runs.some((r) => Object.hasOwn(r.quality, k)))];
  const others = unique(reported.map((n) => n.metric)).filter((k) => !metrics.includes(k));
  fill($("metric"), [["", "all metrics"], ...metrics.map((k) => [k, measure(k).label]), ...others.map((k) => [k, `${measure(k).label} (reported)`])], state.metric);
  state.metric = $("metric").value;
  const costs = ["train_s", "model_mb", "fps", "gaussians", "peak_rss_mb"].filter((k) => runs.some((r) => Object.hasOwn(r.cost, k)));
  fill($("plot-x"), costs.map((k) => [k, measure(k).label]), $("plot-x").value);
  fill($("plot-y"), metrics.map((k) => [k, measure(k).label]), metrics.includes(state.metric) ? state.metric : $("plot-y").value);
}

function draw() {
  fillFilters();
  $("measured").hidden = !runsOf(state.dataset).length;
  drawMeasured();
  drawPlot();
  fillPair();
  drawReported();
}

const pictureKey = (p) => (p.method ? groupKey(p) : PHOTO);
const imageKey = (p) => JSON.stringify([p.scene, p.image]);
const pictures = () => DATA.images.filter((p) => p.dataset === state.dataset && (!state.scene || p.scene === state.scene));

function fillPair() {
  const found = pictures();
  $("compare").hidden = !found.length;
  if (!found.length) return;
  const names = unique(found.map(imageKey)).sort(byName);
  fill($("image"), names.map((k) => [k, JSON.parse(k).join(" / ")]), $("image").value);
  fillSides();
}

function fillSides() {
  const found = pictures().filter((p) => imageKey(p) === $("image").value);
  const named = new Map(groups(state.dataset).map((g) => [g.key, `${g.method} (${g.about})`]));
  const options = found.filter((p) => p.method).map((p) => [pictureKey(p), named.get(pictureKey(p)) ?? `${p.method} (${p.setting})`]).sort((a, b) => byName(a[1], b[1]));
  if (found.some((p) => !p.method)) options.push([PHOTO, "the photo"]);
  fill($("left"), options, $("left").value);
  fill($("right"), options, $("right").value || options.at(-1)[0]);
  drawPair();
}

function drawPair() {
  const found = pictures().filter((p) => imageKey(p) === $("image").value);
  for (const [side, image, said] of [["left", "over", "left-said"], ["right", "under", "right-said"]]) {
    const picture = found.find((p) => pictureKey(p) === $(side).value);
    const name = $(side).selectedOptions[0]?.textContent ?? "";
    const psnr = picture && picture.psnr !== null ? `, PSNR ${shown(number(picture.psnr), 2)}` : "";
    $(image).src = picture ? `images/${picture.file}` : "data:,";
    $(image).alt = `${name} of ${JSON.parse($("image").value).join(" / ")}`;
    $(said).textContent = picture?.method ? `${name}, seed ${picture.seed}${psnr}` : name;
  }
  cutAt(Number($("slider").value));
}

function cutAt(percent) {
  const at = Math.min(Math.max(percent, 0), 100);
  $("slider").value = at;
  $("slider").setAttribute("aria-valuetext", `${Math.round(at)} % left image`);
  $("stage").style.setProperty("--at", `${at}%`);
}

function dragged(event) {
  if (event.type === "pointermove" && !event.buttons) return;
  const box = $("stage").getBoundingClientRect();
  cutAt((100 * (event.clientX - box.left)) / box.width);
}

/** The choice goes into the address, so that it can be sent round; what comes back is checked by `fill`. */
function remember() {
  const words = new URLSearchParams();
  for (const key of ["dataset", "scene", "metric", "method"]) if (state[key]) words.set(key, state[key]);
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
  for (const key of ["dataset", "scene", "metric", "method"]) state[key] = words.get(key) ?? "";
  state.reported = words.get("reported") !== "no";
  const sort = words.get("sort");
  delete state.sort.table;
  if (sort) state.sort.table = { key: sort.replace(/^-/, ""), down: sort.startsWith("-") };
  $("method").value = state.method;
  $("reported").checked = state.reported;
}

function start() {
  const methods = unique(DATA.runs.map((r) => r.method)).length;
  const counted = (n, what) => `${n} ${what}${n === 1 ? "" : "s"}`;
  const scenes = unique(DATA.runs.map((r) => JSON.stringify([r.dataset, r.scene]))).length;
  $("facts").textContent = `${counted(DATA.runs.length, "measured run")}: ${counted(methods, "method")}, ${counted(scenes, "scene")}`
    + (DATA.reported.length ? `; ${counted(DATA.reported.length, "reported number")} beside them` : "");
  $("empty").hidden = DATA.runs.length > 0;
  $("filters").hidden = !DATA.runs.length && !DATA.reported.length;
  $("reported-choice").hidden = !DATA.reported.length;
  $("files").append("Files: ", ...DATA.files.map((name) => h("a", { href: `data/${name}`, download: "" }, name)));
  recall();
  for (const key of ["dataset", "scene", "metric"]) $(key).addEventListener("change", () => { state[key] = $(key).value; draw(); });
  $("method").addEventListener("input", () => { state.method = $("method").value; draw(); });
  $("reported").addEventListener("change", () => { state.reported = $("reported").checked; draw(); });
  window.addEventListener("hashchange", () => { recall(); draw(); });
  $("filters").addEventListener("submit", (event) => event.preventDefault());
  for (const key of ["plot-x", "plot-y"]) $(key).addEventListener("change", drawPlot);
  $("image").addEventListener("change", fillSides);
  for (const key of ["left", "right"]) $(key).addEventListener("change", drawPair);
  $("slider").addEventListener("input", () => cutAt(Number($("slider").value)));
  $("stage").addEventListener("pointerdown", (event) => { $("stage").setPointerCapture(event.pointerId); dragged(event); });
  $("stage").addEventListener("pointermove", dragged);
  draw();
  let width = $("plot").clientWidth;
  new ResizeObserver(() => { if ($("plot").clientWidth !== width) { width = $("plot").clientWidth; drawPlot(); } }).observe($("plot"));
}

start();

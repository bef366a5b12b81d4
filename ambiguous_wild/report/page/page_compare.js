// Two pictures of one view: renders, error maps or masks; a slider or side by side; one zoom for both.
const PHOTO = "photo";
const GAIN = 4; // of the error map
const zoom = { scale: 1, x: 0, y: 0 }; // x, y: share of the picture that is shifted

const pictureKey = (p) => (p.method ? groupKey(p) : PHOTO);
const viewKey = (p) => JSON.stringify([p.scene, p.image]);
const inView = (p, kind) => p.dataset === state.dataset && chosenScenes().includes(p.scene) && p.kind === kind;
const picturesOf = (kind) => DATA.images.filter((p) => inView(p, kind));
let view = ""; // of viewKey

/** A view where the methods differ most comes first: the range of PSNR over the entries that are ranked. */
function viewsByDifference(found) {
  const range = (key) => {
    const values = found.filter((p) => viewKey(p) === key && p.method && !DATA.references.includes(p.method)).map((p) => number(p.psnr)).filter(Number.isFinite);
    return values.length > 1 ? Math.max(...values) - Math.min(...values) : -1;
  };
  return unique(found.map(viewKey)).sort(byName).map((key) => [key, range(key)]).sort((a, b) => b[1] - a[1]).map(([key]) => key);
}

function fill(select, options, value) {
  select.replaceChildren(...options.map(([v, text]) => h("option", { value: v }, text)));
  select.value = options.some(([v]) => v === value) ? value : options[0]?.[0] ?? "";
}

const masksShown = () => $("show").value === "masks";

function fillPair() {
  const test = picturesOf("test"), train = picturesOf("train");
  $("compare").hidden = !test.length && !train.length;
  if ($("compare").hidden) return;
  const masks = [...$("show").options].find((o) => o.value === "masks");
  masks.disabled = !train.length;
  if (masksShown() && !train.length) $("show").value = "renders";
  const found = masksShown() ? train : test;
  const keys = viewsByDifference(found);
  if (!keys.includes(view)) view = keys[0] ?? "";
  $("views").replaceChildren(...[...keys].sort(byName).map((key) => {
    const [scene, image] = JSON.parse(key);
    const photo = found.find((p) => viewKey(p) === key && !p.method) ?? found.find((p) => viewKey(p) === key);
    const press = () => { view = key; fillPair(); [...$("views").children].find((b) => b.dataset.view === key)?.focus(); };
    return h("button", { type: "button", class: "view", "data-view": key, "aria-pressed": String(key === view), onclick: press }, thumbnail(photo, ""), `${scene} / ${image}`);
  }));
  fillSides();
}

function fillSides() {
  const found = picturesOf(masksShown() ? "train" : "test").filter((p) => viewKey(p) === view);
  const named = new Map(groups(state.dataset).map((g) => [g.key, `${g.method} (${g.about})`]));
  const options = found.filter((p) => p.method).map((p) => [pictureKey(p), named.get(pictureKey(p)) ?? `${p.method} (${p.setting})`]).sort((a, b) => byName(a[1], b[1]));
  // At first the entries that differ most; a reference only where nothing else is left.
  const ranked = [...found].filter((p) => p.method && !DATA.references.includes(p.method) && Number.isFinite(number(p.psnr))).sort((a, b) => number(b.psnr) - number(a.psnr));
  const [best, worst] = [ranked[0], ranked.at(-1)].map((p) => (p ? pictureKey(p) : ""));
  if (found.some((p) => !p.method)) options.push([PHOTO, "the photo"]);
  const has = (key) => options.some(([v]) => v === key);
  fill($("left"), options, has($("left").value) ? $("left").value : best);
  fill($("right"), options, has($("right").value) ? $("right").value : best !== worst ? worst : options.at(-1)?.[0]);
  drawPair();
}

/** Choose a view and its left side from elsewhere on the page. */
function showPicture(scene, image, left) {
  if (masksShown()) $("show").value = "renders";
  view = JSON.stringify([scene, image]);
  fillPair();
  $("left").value = left;
  drawPair();
}

function drawPair() {
  const show = $("show").value;
  const found = picturesOf(show === "masks" ? "train" : "test").filter((p) => viewKey(p) === view);
  const photo = found.find((p) => !p.method);
  const exact = show === "masks" ? picturesOf("exact").find((p) => viewKey(p) === view) : null;
  const panes = ["left", "right"].map((side) => {
    const picture = found.find((p) => pictureKey(p) === $(side).value);
    const name = $(side).selectedOptions[0]?.textContent ?? "";
    const psnr = picture?.method && picture.psnr !== null ? `, PSNR ${shown(number(picture.psnr), 2)}` : "";
    $(`${side}-said`).textContent = picture?.method ? `${name}, seed ${picture.seed}${psnr}` : name;
    const layer = (p, kind) => (p ? h("img", { src: `images/${p.file}`, alt: kind === "base" ? `${name} of ${JSON.parse(view).join(" / ")}` : "", class: kind, draggable: "false" }) : null);
    const layers = h("div", { class: "layers" });
    if (show === "masks") layers.append(...[layer(photo, "base"), picture?.method ? layer(picture, "mask") : null, $("exact").checked ? layer(exact, "mask") : null].filter(Boolean));
    else layers.append(...[layer(picture, "base"), show === "error" ? layer(photo, "difference") : null].filter(Boolean));
    return h("div", { class: `pane ${show}`, id: side === "left" ? "over" : "under" }, layers);
  });
  $("stage").className = $("layout").value;
  $("stage").replaceChildren(panes[1], panes[0], h("div", { id: "cut", "aria-hidden": "true" }));
  if ($("layout").value === "side") $("stage").prepend(panes[0]);
  $("slider").hidden = $("layout").value !== "slider";
  $("exact-choice").hidden = show !== "masks" || !exact;
  $("show-said").textContent = {
    renders: "",
    error: photo ? `Error map: the absolute difference to the test photo, ${GAIN} times as bright; black is no error.` : "No photo of this view was kept: no error map.",
    masks: `Red: what the method leaves out of training in this photo.${exact ? " Blue: the exact mask; both together look violet." : ""}`,
  }[show];
  cutAt(Number($("slider").value));
  applyZoom();
}

function cutAt(percent) {
  const at = Math.min(Math.max(percent, 0), 100);
  $("slider").value = at;
  $("slider").setAttribute("aria-valuetext", `${Math.round(at)} % left image`);
  $("stage").style.setProperty("--at", `${at}%`);
}

/** The same scale and place in both panes; x and y stay inside the picture. */
function applyZoom() {
  const most = 1 - 1 / zoom.scale;
  zoom.x = Math.min(Math.max(zoom.x, 0), most);
  zoom.y = Math.min(Math.max(zoom.y, 0), most);
  for (const layers of document.querySelectorAll("#stage .layers"))
    layers.style.transform = `scale(${zoom.scale}) translate(${-100 * zoom.x}%, ${-100 * zoom.y}%)`;
  $("stage").classList.toggle("zoomed", zoom.scale > 1);
  $("zoom-said").textContent = zoom.scale > 1 ? `${zoom.scale.toFixed(1)} times; drag or use the arrow keys to move` : "";
}

/** Scale by a factor around a point of the picture: shares of the pane, 0.5 is its middle. */
function zoomBy(factor, px = 0.5, py = 0.5) {
  const next = Math.min(Math.max(zoom.scale * factor, 1), 32);
  zoom.x += px / zoom.scale - px / next;
  zoom.y += py / zoom.scale - py / next;
  zoom.scale = next;
  applyZoom();
}

/** One pixel of the picture on one of the screen. */
function fullSize() {
  const image = document.querySelector("#stage img.base");
  if (image) zoomBy(Math.max(image.naturalWidth / image.clientWidth, 1) / zoom.scale);
}

let drag = null;
function dragged(event) {
  const box = ($("layout").value === "side" ? event.target.closest(".pane") ?? $("over") : $("stage")).getBoundingClientRect();
  if (event.type === "pointerdown") {
    drag = { x: event.clientX, y: event.clientY };
    $("stage").setPointerCapture(event.pointerId);
  } else if (!drag || !event.buttons) return;
  if (zoom.scale > 1) {
    const pane = $("over").getBoundingClientRect();
    zoom.x -= (event.clientX - drag.x) / pane.width / zoom.scale;
    zoom.y -= (event.clientY - drag.y) / pane.height / zoom.scale;
    drag = { x: event.clientX, y: event.clientY };
    applyZoom();
  } else if ($("layout").value === "slider") cutAt((100 * (event.clientX - box.left)) / box.width);
}

function startPair() {
  for (const key of ["left", "right", "layout", "exact"]) $(key).addEventListener("change", drawPair);
  $("show").addEventListener("change", fillPair);
  $("slider").addEventListener("input", () => cutAt(Number($("slider").value)));
  for (const kind of ["pointerdown", "pointermove"]) $("stage").addEventListener(kind, dragged);
  $("stage").addEventListener("pointerup", () => { drag = null; });
  $("stage").addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return; // the page scrolls as ever
    event.preventDefault();
    const box = (event.target.closest(".pane") ?? $("over")).getBoundingClientRect();
    zoomBy(event.deltaY < 0 ? 1.25 : 0.8, (event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
  }, { passive: false });
  $("stage").tabIndex = 0;
  $("stage").setAttribute("role", "group");
  $("stage").setAttribute("aria-label", "The two images; plus and minus zoom, arrow keys move");
  $("stage").addEventListener("keydown", (event) => {
    const step = 0.1 / zoom.scale;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (event.key === "+" || event.key === "=") zoomBy(1.5);
    else if (event.key === "-") zoomBy(1 / 1.5);
    else if (event.key in moves && zoom.scale > 1) {
      zoom.x += moves[event.key][0];
      zoom.y += moves[event.key][1];
      applyZoom();
    } else return;
    event.preventDefault();
  });
  $("zoom-in").addEventListener("click", () => zoomBy(1.5));
  $("zoom-out").addEventListener("click", () => zoomBy(1 / 1.5));
  $("zoom-fit").addEventListener("click", () => zoomBy(1 / zoom.scale));
  $("zoom-full").addEventListener("click", fullSize);
}

// Masks over photos: whose they are, why a pixel is masked or kept, and corrections by hand.
const UNCHANGED = 128; // in corrections.json; 0 = distractor, 255 = static
const CORRECTION_WIDTH = 480; // px, as the reader of corrections.json allows
const BRUSH = [0.012, 0.04]; // radius, as a share of the photo's width
const STEPS = 30; // that can be undone
const KEY = `aw corrections: ${DATA.scene} ${location.pathname}`;
const corrections = new Map(); // name of a photo -> canvas
const steps = []; // [name, its pixels before the step, whether they were saved]
let correctionsSaved = true, correctionsKept = true; // in a file; by the browser

/** The shown model whose mask of this photo is painted: the right one if both have one. */
function maskModel(view) {
  const shown = state.mode === "single" && state.left !== PHOTO ? [state.left] : [state.right, state.left];
  return shown.filter((c) => c !== PHOTO).map((c) => DATA.models[c]).find((m) => view && Object.hasOwn(m.masks, view.name));
}

/** Paint a view's photo into a canvas: what is masked turns red, corrections orange and blue, features become dots. */
async function paintPhoto(canvas, view) {
  const model = state.masks ? maskModel(view) : undefined;
  const [photo, mask] = await Promise.all([image(view.photo), model && image(model.masks[view.name])]);
  const { naturalWidth: width, naturalHeight: height } = photo;
  Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(photo, 0, 0);
  const byHand = state.masks && corrections.get(view.name);
  if (mask || byHand) paintMask(context, width, height, mask, byHand);
  if (state.masks) paintPoints(canvas, context, view.points);
  const painted = model ? [`mask of ${model.label}`] : [];
  if (byHand) painted.push("orange: masked by hand, blue: kept by hand");
  if (state.masks && view.points.length) painted.push("green features stay, red ones move");
  return painted.join("; ");
}

function paintPoints(canvas, context, points) {
  const radius = Math.max(canvas.width / 320, 1);
  for (let i = 0; i < points.length; i += 3) {
    context.fillStyle = points[i + 2] ? "#ff2d20" : "#20c040";
    context.beginPath();
    context.arc(points[i] / 999 * canvas.width, points[i + 1] / 999 * canvas.height, radius, 0, 7);
    context.fill();
  }
}

function paintMask(context, width, height, mask, byHand) {
  const pixels = context.getImageData(0, 0, width, height), { data } = pixels;
  const kept = mask && scaled(mask, width, height), hand = byHand && scaled(byHand, width, height);
  const tint = (i, ...colour) => colour.forEach((value, k) => { data[i + k] = 0.45 * data[i + k] + 0.55 * value; });
  for (let i = 0, k = 0; i < data.length; i += 4, k++) {
    if (hand && hand[k] !== UNCHANGED) hand[k] ? tint(i, 40, 140, 255) : tint(i, 255, 150, 0);
    else if (kept && kept[k] <= 127) tint(i, 255, 0, 0);
  }
  context.putImageData(pixels, 0, 0);
}

/** Gray values of a picture or canvas at a size, without mixing pixels. */
function scaled(source, width, height) {
  const context = Object.assign(h("canvas"), { width, height }).getContext("2d", { willReadFrequently: true });
  context.imageSmoothingEnabled = false;
  context.drawImage(source, 0, 0, width, height);
  const { data } = context.getImageData(0, 0, width, height), gray = new Uint8Array(width * height);
  for (let k = 0; k < gray.length; k++) gray[k] = data[4 * k];
  return gray;
}

/** Why the pixel at u, v (shares of the photo) is masked or kept, as a sentence; "" if nothing is known of it. */
async function reasonAt(view, u, v) {
  const model = maskModel(view);
  if (!model) return view.split === "test" && DATA.models.some((m) => Object.keys(m.masks).length) ? "a test photo: it has no mask" : "";
  const at = (source, width, height) => scaled(source, width, height)[Math.min(Math.floor(v * height), height - 1) * width + Math.min(Math.floor(u * width), width - 1)];
  const byHand = corrections.get(view.name);
  const hand = byHand ? at(byHand, byHand.width, byHand.height) : UNCHANGED;
  if (hand !== UNCHANGED) return hand ? "kept: by hand" : "masked: by hand";
  const reasons = model.reasons[view.name];
  if (reasons) {
    const map = await image(reasons.regions);
    const sentence = reasons.sentences[at(map, map.naturalWidth, map.naturalHeight) - 1];
    if (sentence) return sentence;
  }
  const mask = await image(model.masks[view.name]);
  return `${at(mask, mask.naturalWidth, mask.naturalHeight) > 127 ? "kept" : "masked"} by ${model.label}`;
}

/** The canvas of a photo's corrections; a step back is kept first. */
function correcting(view) {
  let canvas = corrections.get(view.name);
  if (!canvas) {
    canvas = h("canvas");
    canvas.width = Math.min(CORRECTION_WIDTH, view.width);
    canvas.height = Math.max(1, Math.round((canvas.width * view.height) / view.width));
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.fillStyle = "#808080";
    context.fillRect(0, 0, canvas.width, canvas.height);
    corrections.set(view.name, canvas);
  }
  const context = canvas.getContext("2d", { willReadFrequently: true });
  steps.push([view.name, context.getImageData(0, 0, canvas.width, canvas.height), correctionsSaved]);
  if (steps.length > STEPS) steps.shift();
  correctionsSaved = false;
  return context;
}

/** Paint a round brush from one point to another, in shares of the photo; rows of whole pixels keep the edge hard. */
function brush(context, from, to, kept, large) {
  const { width, height } = context.canvas, radius = Math.max(Math.round(BRUSH[large ? 1 : 0] * width), 1);
  const [dx, dy] = [(to[0] - from[0]) * width, (to[1] - from[1]) * height];
  const count = Math.max(Math.ceil(Math.hypot(dx, dy) / radius), 1);
  context.fillStyle = kept ? "#fff" : "#000";
  for (let n = 0; n <= count; n++) {
    const x = Math.floor(from[0] * width + (dx * n) / count), y = Math.floor(from[1] * height + (dy * n) / count);
    for (let row = -radius; row <= radius; row++) {
      const half = Math.floor(Math.sqrt(radius * radius - row * row));
      context.fillRect(x - half, y + row, 2 * half + 1, 1);
    }
  }
}

/** Toggle what is connected to a point: a masked blob, or a region that is kept for one reason. Returns a complaint or "". */
async function toggleRegion(view, u, v) {
  const model = maskModel(view);
  const [mask, map] = await Promise.all([model && image(model.masks[view.name]), model?.reasons[view.name] && image(model.reasons[view.name].regions)]);
  const context = correcting(view), { width, height } = context.canvas, size = width * height;
  const kept = mask ? scaled(mask, width, height) : new Uint8Array(size).fill(255);
  const hand = scaled(context.canvas, width, height), labels = map && scaled(map, width, height);
  const isKept = (k) => (hand[k] === UNCHANGED ? kept[k] > 127 : hand[k] > 0);
  const seed = Math.min(Math.floor(v * height), height - 1) * width + Math.min(Math.floor(u * width), width - 1);
  const was = isKept(seed), reached = new Uint8Array(size), todo = [seed];
  const joins = (k) => !reached[k] && isKept(k) === was && (!was || !labels || labels[k] === labels[seed]);
  reached[seed] = 1;
  for (let n = 0; n < todo.length; n++) {
    const k = todo[n], x = k % width;
    for (const [other, inside] of [[k - 1, x > 0], [k + 1, x < width - 1], [k - width, k >= width], [k + width, k < size - width]]) {
      if (inside && joins(other)) { reached[other] = 1; todo.push(other); }
    }
  }
  if (was && todo.length > 0.5 * size) {
    undo();
    return "this region is more than half of the photo: use the brush";
  }
  context.fillStyle = was ? "#000" : "#fff";
  for (const k of todo) context.fillRect(k % width, Math.floor(k / width), 1, 1);
  return "";
}

function undo() {
  const [name, pixels, saved] = steps.pop() ?? [];
  if (!pixels) return;
  corrections.get(name).getContext("2d").putImageData(pixels, 0, 0);
  if (pixels.data.every((value, i) => i % 4 === 3 || value === UNCHANGED)) corrections.delete(name);
  correctionsSaved = saved || !corrections.size; // without corrections nothing can be lost
}

const correctionsFile = () => ({
  version: 1,
  scene: DATA.scene,
  photos: Object.fromEntries([...corrections].map(([name, canvas]) => [name, canvas.toDataURL("image/png")])),
});

function saveCorrections() {
  save("corrections.json", new Blob([JSON.stringify(correctionsFile())], { type: "application/json" }));
  correctionsSaved = true;
  for (const step of steps) step[2] = false; // the file holds more than was there before them
  keepCorrections();
}

/** Corrections survive a reload where the browser stores something for this page. */
function keepCorrections() {
  try {
    localStorage.setItem(KEY, JSON.stringify({ saved: correctionsSaved, file: correctionsFile() }));
    correctionsKept = true;
  } catch {
    correctionsKept = false;
  }
}

async function recallCorrections() {
  try {
    const { saved, file } = JSON.parse(localStorage.getItem(KEY) ?? "{}");
    for (const view of DATA.views.filter((v) => file && Object.hasOwn(file.photos, v.name))) {
      const context = correcting(view);
      context.drawImage(await image(file.photos[view.name]), 0, 0, context.canvas.width, context.canvas.height);
    }
    steps.length = 0;
    correctionsSaved = saved || !corrections.size;
  } catch {
    corrections.clear();
  }
}

/** The photo in the corner: a click enlarges it, then says why; while masks are corrected it is painted on. */
function listenToPhoto() {
  const canvas = $("photo").querySelector("canvas");
  let stroke = null;
  const complain = (text) => { $("corrected").textContent = text; };
  const done = () => { stroke = null; keepCorrections(); drawPhotos(); };
  canvas.addEventListener("pointerdown", async (event) => {
    const view = DATA.views[state.view], at = inPhoto(event, canvas.getBoundingClientRect());
    if (!state.correct || !at) return;
    if (view.split !== "train") return complain("test photos have no mask");
    complain("");
    if (state.tool === "region") {
      complain(await toggleRegion(view, ...at));
      return done();
    }
    canvas.setPointerCapture(event.pointerId);
    stroke = { context: correcting(view), at };
    brush(stroke.context, at, at, state.tool === "keep", state.large);
    drawPhotos();
  });
  canvas.addEventListener("pointermove", (event) => {
    const at = stroke && inPhoto(event, canvas.getBoundingClientRect());
    if (!at) return;
    brush(stroke.context, stroke.at, at, state.tool === "keep", state.large);
    stroke.at = at;
    drawPhotos();
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, () => stroke && done());
  canvas.addEventListener("click", (event) => {
    if (state.correct) return;
    if (state.inset === "large") explain(event, canvas.getBoundingClientRect());
    else choose({ inset: "large" });
  });
  $("fold").addEventListener("click", () => choose({ inset: state.inset === "large" || state.inset === "closed" ? "" : "closed" }));
}

/** Corrections are painted on a train photo: the one that is shown, else the one with the largest mask. */
function correct() {
  const view = DATA.views[state.view]?.split === "train" ? state.view : Math.max(DATA.opening.view, DATA.views.findIndex((v) => v.split === "train"));
  $("corrected").textContent = "";
  return choose(state.correct ? { correct: false } : { correct: true, tool: state.tool ?? "mask", view, masks: true });
}

function stepBack() {
  undo();
  keepCorrections();
  return drawPhotos();
}

function keepFile() {
  if (!corrections.size) {
    $("corrected").textContent = "nothing is corrected yet";
    return;
  }
  saveCorrections();
  nextSteps();
  openPanel("next-steps", true);
}

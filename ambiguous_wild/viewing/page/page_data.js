// What the page knows, and small helpers. Text of scenes and methods enters as text, never as markup.
const DATA = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const PHOTO = "photo";
const state = { ...opening(), view: null, masks: true, frusta: false, cut: 50, path: [] };

/** Two models or more open under the slider, the best on the right, references last; a phone draws one at first. */
function opening() {
  const means = DATA.models.map((m) => (m.reference ? -1000 : 0) + (m.mean ?? -100));
  if (means.length < 2) return { left: 0, right: PHOTO, mode: "single" };
  const best = means.indexOf(Math.max(...means));
  const other = best ? 0 : 1;
  if (matchMedia("(pointer: coarse)").matches) return { left: best, right: other, mode: "single" };
  return { left: other, right: best, mode: "cut" };
}

/** The camera to open at: the test photo that the model drawn best knows best. */
function firstView() {
  const tests = DATA.views.flatMap((v, i) => (v.split === "test" ? [i] : []));
  const psnr = (i) => Math.max(...DATA.models.map((m) => m.psnr[DATA.views[i].name] ?? -Infinity));
  return tests.length ? tests.reduce((a, b) => (psnr(b) > psnr(a) ? b : a)) : DATA.views.length ? 0 : null;
}

function h(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function fill(select, options) {
  select.replaceChildren(...options.map(([value, text]) => h("option", { value }, text)));
}

/** The bytes of an element that holds base64 text; the text is dropped when it is not needed again. */
function bytesOf(id) {
  const binary = atob($(id).textContent);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

/** three.js, OrbitControls and Spark: one module, unpacked here because a page from a file cannot load another. */
async function loadRenderer() {
  const stream = new Blob([bytesOf("renderer")]).stream().pipeThrough(new DecompressionStream("gzip"));
  const text = await new Response(stream).blob();
  const url = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
  try {
    return await import(url);
  } finally {
    URL.revokeObjectURL(url);
    $("renderer").textContent = "";
  }
}

const shown = (value, digits = 2) => (typeof value === "number" ? value.toFixed(digits) : "—");

function image(uri) {
  return new Promise((resolve, reject) => {
    const picture = new Image();
    picture.onload = () => resolve(picture);
    picture.onerror = () => reject(new Error("a photo of this page is damaged"));
    picture.src = uri;
  });
}

/** Paint a view's photo into a canvas: what the method's mask leaves out turns red, features become dots. */
async function paintPhoto(canvas, view, model) {
  const photo = await image(view.photo);
  canvas.width = photo.naturalWidth;
  canvas.height = photo.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(photo, 0, 0);
  const mask = state.masks && model && model.masks[view.name];
  if (mask) await paintMask(canvas, context, mask);
  if (state.masks) paintPoints(canvas, context, view.points);
  const painted = mask ? [`mask of ${model.label}`] : [];
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

async function paintMask(canvas, context, mask) {
  const keep = await image(mask);
  const pixels = context.getImageData(0, 0, canvas.width, canvas.height);
  context.imageSmoothingEnabled = false;
  context.drawImage(keep, 0, 0, canvas.width, canvas.height);
  const kept = context.getImageData(0, 0, canvas.width, canvas.height).data;
  for (let i = 0; i < kept.length; i += 4) {
    if (kept[i] > 127) continue;
    pixels.data[i] = 0.45 * pixels.data[i] + 0.55 * 255;
    pixels.data[i + 1] *= 0.45;
    pixels.data[i + 2] *= 0.45;
  }
  context.putImageData(pixels, 0, 0);
}

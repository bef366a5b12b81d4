// What the page knows, and small helpers. Text of scenes and methods enters as text, never as markup.
const DATA = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const PHOTO = "photo";
const state = { masks: true, frusta: false, cut: 50, path: [], ...opening() };

/** A phone draws one model at first: the one that masks what does not belong, or the best. */
function opening() {
  const { left, right, view } = DATA.opening;
  const main = right === PHOTO ? left : right;
  const one = right === PHOTO || matchMedia("(pointer: coarse)").matches;
  return one ? { left: main, right: main === right ? left : right, mode: "single", view } : { left, right, mode: "cut", view };
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

/** Pictures that were decoded last, so that a brush need not wait for them. */
const decoded = new Map();

function image(uri) {
  const known = decoded.get(uri) ?? new Promise((resolve, reject) => {
    const picture = new Image();
    picture.onload = () => resolve(picture);
    picture.onerror = () => reject(new Error("a photo of this page is damaged"));
    picture.src = uri;
  });
  decoded.delete(uri);
  decoded.set(uri, known);
  if (decoded.size > 8) decoded.delete(decoded.keys().next().value);
  return known;
}

/** Save a file as the browser saves downloads. */
function save(name, blob) {
  const url = URL.createObjectURL(blob);
  h("a", { href: url, download: name.replace(/[^\p{L}\p{N}@+.,_-]+/gu, "_") }).click();
  setTimeout(() => URL.revokeObjectURL(url), 1000);
}

/** Text in which commands and paths stand between two `. */
function withCode(text) {
  return text.split("`").map((part, index) => (index % 2 ? h("code", {}, part) : part));
}

// What is chosen, what moves the camera, and the way all of it comes together.
let R, T, camera, controls, over, under, wanted = true, pressed = new Set();
let drawnAt = 0; // when the page was drawn for the first time
let lastPicture = "", drawing = false; // what is shown; whether it is not yet on the screen
let touched = location.hash.length > 1; // whether somebody chose what is shown
const MOST_RELOADS = 10; // without a new state: a training that was killed writes none
const isBeside = () => state.mode === "beside";
const panes = () => (state.mode === "single" ? [over] : [over, under]);
const dirty = () => { wanted = true; };

function psnrLine() {
  const view = DATA.views[state.view];
  if (!view) return `${DATA.models.length} ${DATA.models.length === 1 ? "model" : "models"}; free camera`;
  const chosen = [state.left, ...(state.mode === "single" ? [] : [state.right])].filter((c) => c !== PHOTO);
  const values = chosen.filter((c) => Object.hasOwn(DATA.models[c].psnr, view.name))
    .map((c) => `${DATA.models[c].label} ${shown(DATA.models[c].psnr[view.name])} dB${DATA.mixed ? "*" : ""}`);
  return [view.split ? `${view.split} photo` : "render", ...values].join(" · ");
}

async function drawPhotos() {
  const view = DATA.views[state.view];
  const atPane = panes().some((pane) => pane.choice === PHOTO) && !state.correct;
  const inset = state.correct ? "large" : state.inset ?? "";
  $("photo").hidden = !view || atPane;
  $("photo").className = inset;
  $("fold").hidden = Boolean(state.correct);
  $("fold").textContent = inset === "closed" ? "Photo" : "✕";
  $("fold").setAttribute("aria-expanded", String(inset !== "closed"));
  $("fold").setAttribute("aria-label", { closed: "Show the photo", large: "Make the photo small", "": "Hide the photo" }[inset]);
  for (const pane of panes()) await pane.drawPhoto(view);
  if (!view || atPane) return;
  const painted = await paintPhoto($("photo").querySelector("canvas"), view);
  $("photo").querySelector("figcaption span").textContent = [view.name, painted].filter(Boolean).join(": ");
}

/** Where the page opened: what the mask removes there, named above its place in the picture. */
function placeStood() {
  const view = DATA.views[state.view], at = DATA.opening.place;
  $("stood").hidden = Boolean(!view || !at || state.view !== DATA.opening.view || state.correct || state.inset === "large");
  if ($("stood").hidden) return;
  const pane = isBeside() ? under.element : over.element;
  const { scale, left, top } = fitted(view, pane.clientWidth, pane.clientHeight);
  const x = pane.offsetLeft + left + at[0] * scale * view.width;
  $("stood").style.left = `${Math.min(Math.max(x, 90), $("stage").clientWidth - 90)}px`;
  $("stood").style.top = `${Math.max(top + at[1] * scale * view.height, 60)}px`;
}

function placeFrame() {
  const view = DATA.views[state.view];
  $("frame").hidden = !view;
  if (!view) return;
  const { scale, left, top } = fitted(view, over.element.clientWidth, over.element.clientHeight);
  Object.assign($("frame").style, { left: `${left}px`, top: `${top}px`, width: `${scale * view.width}px`, height: `${scale * view.height}px` });
}

/** Cut the upper pane and its label at the handle. */
function placeCut() {
  $("over").style.clipPath = state.mode === "cut" ? `inset(0 ${100 - state.cut}% 0 0)` : "none";
  $("handle").style.left = `${state.cut}%`;
  $("slider").value = state.cut;
}

async function refresh() {
  for (const mode of ["single", "beside", "cut"]) $(mode).setAttribute("aria-pressed", String(state.mode === mode));
  for (const key of ["frusta", "masks", "correct"]) $(key).setAttribute("aria-pressed", String(Boolean(state[key])));
  $("stage").dataset.mode = state.mode;
  $("right-choice").hidden = state.mode === "single";
  $("left").value = String(state.left);
  $("right").value = String(state.right);
  $("view").value = state.view === null ? "" : String(state.view);
  $("said").textContent = psnrLine();
  for (const tool of ["mask", "keep", "region"]) $(`tool-${tool}`).setAttribute("aria-pressed", String(state.tool === tool));
  $("large-brush").setAttribute("aria-pressed", String(Boolean(state.large)));
  $("tools").hidden = !state.correct;
  $("why").textContent = "";
  nextSteps();
  placeCut();
  placeFrame();
  placeStood();
  const picture = shownPicture();
  busy("loading the model");
  try {
    await over.show(state.left);
    if (state.mode !== "single") await under.show(state.right);
    await drawPhotos();
    if (state.frusta) paintAllFrusta();
    if (picture !== lastPicture) {
      for (const pane of panes()) pane.drawn = false;
      drawing = true;
    }
    lastPicture = picture;
    busy(drawing ? DRAWING : "");
  } catch (error) {
    busy(`cannot show this model: ${error.message}`);
  }
  dirty();
}

/** What decides about names beside a picture; a free camera that moves is not a new picture. */
const shownPicture = () => JSON.stringify([state.left, state.mode === "single" || state.right, state.mode, state.view]);

const DRAWING = "drawing …";
/** An old picture must not stand under a new name: it is hidden until the new one is drawn. */
function busy(text) {
  $("busy").textContent = text;
  $("stage").classList.toggle("drawing", text === DRAWING);
}
function busyFor(text) {
  busy(text);
  setTimeout(() => { if ($("busy").textContent === text) busy(""); }, 2500);
}

function paintAllFrusta() {
  for (const pane of panes()) {
    if (!pane.frusta || pane.painted) continue;
    pane.painted = true;
    paintFrusta(T, pane.frusta, DATA.views, dirty).catch((error) => busy(error.message));
  }
}

function choose(changes) {
  Object.assign(state, changes);
  if (state.view !== null) state.lens = state.view;
  controls.enabled = true;
  return refresh();
}

function step(by) {
  const count = DATA.views.length;
  if (count) choose({ view: ((state.view ?? (by > 0 ? -1 : 0)) + by + count) % count });
}

/** Leave the photo's camera at its place: from here on the mouse turns it about the middle of the scene. */
function free() {
  if (state.view === null) return;
  const forward = new T.Vector3(0, 0, -1).applyQuaternion(camera.quaternion);
  const middle = new T.Vector3(...DATA.middle);
  const depth = Math.max(middle.sub(camera.position).dot(forward), 0.2 * DATA.extent);
  controls.target.copy(camera.position).addScaledVector(forward, depth);
  state.view = null;
  lastPicture = shownPicture();
  refresh();
}

function home() {
  const up = new T.Vector3(...DATA.up), first = DATA.views.find((v) => v.split === "test") ?? DATA.views[0];
  controls.target.set(...DATA.middle);
  lookThrough(T, camera, first, 100, 100);
  const away = camera.position.clone().sub(controls.target).multiplyScalar(1.4).addScaledVector(up, 0.4 * DATA.extent);
  camera.position.copy(controls.target).add(away);
  camera.up.copy(up);
  choose({ view: null });
}

function toggleMap() {
  if (!DATA.map) return;
  $("map").hidden = !$("map").hidden;
  $("chart").setAttribute("aria-pressed", String(!$("map").hidden));
}

function addToPath() {
  state.path.push(pathEntry(camera));
  $("path").textContent = `Path (${state.path.length})`;
}

/** Keys move the camera while they are held. */
function fly(seconds) {
  const way = new T.Vector3(
    (pressed.has("d") ? 1 : 0) - (pressed.has("a") ? 1 : 0),
    (pressed.has("e") ? 1 : 0) - (pressed.has("q") ? 1 : 0),
    (pressed.has("s") ? 1 : 0) - (pressed.has("w") ? 1 : 0),
  );
  if (!way.lengthSq()) return;
  free();
  way.applyQuaternion(camera.quaternion).multiplyScalar(0.5 * DATA.extent * Math.min(seconds, 0.1));
  camera.position.add(way);
  controls.target.add(way);
  dirty();
}

let last = performance.now();
function loop(now) {
  requestAnimationFrame(loop);
  fly((now - last) / 1000);
  last = now;
  if (!wanted) {
    if (drawing && $("busy").textContent === DRAWING && panes().every((pane) => pane.settled)) {
      drawing = false;
      busy("");
      drawnAt ||= now;
    }
    return;
  }
  wanted = false;
  const width = over.element.clientWidth, height = over.element.clientHeight;
  if (!width || !height) return;
  if (state.view === null) {
    controls.update();
    freeProjection(camera, width, height);
    camera.updateMatrixWorld(true);
  } else lookThrough(T, camera, DATA.views[state.view], width, height);
  for (const pane of panes()) pane.draw(camera);
}

/** A click: look through a camera that is drawn there, else say of the photo's pixel why it is masked or kept. */
function pick(event) {
  const pane = isBeside() && event.clientX > $("stage").getBoundingClientRect().left + $("stage").clientWidth / 2 ? under : over;
  const box = pane.element.getBoundingClientRect();
  if (!state.frusta || !pane.frusta) return explain(event, box);
  const at = new T.Vector2((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
  const ray = new T.Raycaster();
  ray.setFromCamera(at, camera);
  const faces = pane.frusta.children.filter((f) => f.visible).map((f) => f.children[1]);
  const hit = ray.intersectObjects(faces, false)[0];
  if (hit) choose({ view: hit.object.userData.view });
  else explain(event, box);
}

/** Where an event is in the photo that lies fitted in a box, as shares of the photo; null beside it. */
function inPhoto(event, box) {
  const view = DATA.views[state.view];
  if (!view) return null;
  const { scale, left, top } = fitted(view, box.width, box.height);
  const u = (event.clientX - box.left - left) / (scale * view.width), v = (event.clientY - box.top - top) / (scale * view.height);
  return u >= 0 && u < 1 && v >= 0 && v < 1 ? [u, v] : null;
}

async function explain(event, box) {
  const at = inPhoto(event, box), stage = $("stage").getBoundingClientRect();
  $("why").textContent = at ? await reasonAt(DATA.views[state.view], ...at) : "";
  const x = event.clientX - stage.left, y = event.clientY - stage.top;
  const [right, below] = [x > stage.width / 2, y > stage.height / 2];
  // one corner is the pixel
  Object.assign($("why").style, {
    left: right ? "auto" : `${x}px`, right: right ? `${stage.width - x}px` : "auto",
    top: below ? "auto" : `${y}px`, bottom: below ? `${stage.height - y}px` : "auto",
    borderRadius: ["0 4px 4px", "4px 0 4px 4px", "4px 4px 4px 0", "4px 4px 0"][(below ? 2 : 0) + (right ? 1 : 0)],
  });
}

/** What can be taken away, and what comes next. */
function nextSteps() {
  const models = [...new Set(panes().map((pane) => (pane === over ? state.left : state.right)))].filter((c) => c !== PHOTO).map((c) => DATA.models[c]);
  const buttons = models.map((model) => {
    const button = h("button", { type: "button" }, `Save ${model.label}.spz`, model.whole ? "" : " (reduced for this page)");
    button.addEventListener("click", () => save(`${model.label}.spz`, new Blob([bytesOf(model.element)])));
    return button;
  });
  const lines = DATA.next.map((line) => h("p", {}, ...withCode(line)));
  const masking = maskModel(DATA.views[state.view] ?? DATA.views[DATA.opening.view]);
  if (corrections.size && masking?.retrain) {
    lines.unshift(h("p", {}, "train on with the corrected masks, in the folder of corrections.json: ", h("code", {}, masking.retrain)));
  }
  $("next-steps").replaceChildren(...buttons, ...lines);
}

/** Open or close a panel; the other one closes. */
function openPanel(id, wanted = $(id).hidden) {
  for (const [panel, button] of [["help", "help-button"], ["next-steps", "next-button"]]) {
    $(panel).hidden = panel !== id || !wanted;
    $(button).setAttribute("aria-expanded", String(!$(panel).hidden));
  }
}

/** Escape closes what was opened last. */
function closeLast() {
  if (!$("help").hidden || !$("next-steps").hidden) openPanel("help", false);
  else if ($("why").textContent) $("why").textContent = "";
  else if (!$("map").hidden) toggleMap();
  else if (state.correct) correct();
  else if (state.inset === "large") choose({ inset: "" });
}

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || /^(SELECT|INPUT)$/.test(event.target.tagName)) return;
  const key = event.key.toLowerCase();
  if ("wasdqe".includes(key) && key.length === 1) pressed.add(key);
  else if (key === "arrowright") step(1);
  else if (key === "arrowleft") step(-1);
  else if (key === "c") choose({ frusta: !state.frusta });
  else if (key === "m") choose({ masks: !state.masks });
  else if (key === "h") home();
  else if (key === "t") toggleMap();
  else if (key === "p") addToPath();
  else if (key === "z" && state.correct) stepBack();
  else if (key === "escape") closeLast();
  else if (key === "v") choose({ mode: { single: "beside", beside: "cut", cut: "single" }[state.mode] });
  else if (/^[1-9]$/.test(key) && Number(key) <= DATA.models.length) choose({ left: Number(key) - 1 });
  else return;
  event.preventDefault();
}

function listen() {
  for (const mode of ["single", "beside", "cut"]) $(mode).addEventListener("click", () => choose({ mode }));
  for (const key of ["frusta", "masks"]) $(key).addEventListener("click", () => choose({ [key]: !state[key] }));
  const chosen = (value) => (value === PHOTO ? PHOTO : Number(value));
  for (const side of ["left", "right"]) $(side).addEventListener("change", (event) => choose({ [side]: chosen(event.target.value) }));
  $("view").addEventListener("change", (event) => (event.target.value === "" ? free() : choose({ view: Number(event.target.value) })));
  $("previous").addEventListener("click", () => step(-1));
  $("next").addEventListener("click", () => step(1));
  $("home").addEventListener("click", home);
  for (const id of ["chart", "map"]) $(id).addEventListener("click", toggleMap);
  $("path").addEventListener("click", () => (state.path.length > 1 ? savePath() : busyFor("press P at two cameras or more, then save the path")));
  $("slider").addEventListener("input", () => { state.cut = Number($("slider").value); placeCut(); });
  $("help-button").addEventListener("click", () => openPanel("help"));
  $("next-button").addEventListener("click", () => openPanel("next-steps"));
  $("more").addEventListener("click", () => {
    const isOpen = document.querySelector("header").classList.toggle("open");
    $("more").setAttribute("aria-expanded", String(isOpen));
  });
  $("correct").addEventListener("click", correct);
  for (const tool of ["mask", "keep", "region"]) $(`tool-${tool}`).addEventListener("click", () => choose({ tool }));
  $("large-brush").addEventListener("click", () => choose({ large: !state.large }));
  $("undo").addEventListener("click", stepBack);
  $("save-corrections").addEventListener("click", keepFile);
  listenToPhoto();
  window.addEventListener("keydown", onKey);
  window.addEventListener("keyup", (event) => pressed.delete(event.key.toLowerCase()));
  window.addEventListener("blur", () => pressed.clear());
  // A click leaves the photo's camera where it is, and says why; a drag turns from there.
  let down = null;
  const moved = (event) => down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) >= 5;
  $("touch").addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; }, { capture: true });
  $("touch").addEventListener("pointermove", (event) => { if (moved(event)) free(); }, { capture: true });
  $("touch").addEventListener("pointerup", (event) => {
    if (down && !moved(event)) pick(event);
    down = null;
  });
  $("touch").addEventListener("pointercancel", () => { down = null; });
  controls.addEventListener("start", () => { if (!down) free(); }); // the wheel
  controls.addEventListener("change", dirty);
  window.addEventListener("beforeunload", (event) => { if (!correctionsKept && !correctionsSaved) event.preventDefault(); });
  new ResizeObserver(() => { placeFrame(); placeStood(); drawPhotos(); dirty(); }).observe($("stage"));
  window.addEventListener("hashchange", recall);
}

/** While a run trains, its page is written again and again: load it anew, unless somebody is at work in this one. */
function keepUp() {
  let used = 0, down = false;
  const tell = (text) => { $("training").textContent = `${DATA.training}; ${text}`; };
  if (reloads() > MOST_RELOADS) return tell("nothing has changed for long, so this page waits no longer: reload it if the training goes on");
  for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel", "keydown", "wheel", "input"]) {
    window.addEventListener(kind, (event) => {
      if (kind === "pointermove" && !down) return;
      if (kind.startsWith("pointer")) down = event.buttons > 0;
      used = performance.now();
      touched = true;
    }, { capture: true, passive: true });
  }
  setInterval(() => {
    const now = performance.now();
    const works = down || pressed.size || (used && now - used < 5000);
    tell(unsaved() ? "this page is not refreshed before you save your work" : "this page shows the next state by itself");
    if (!drawnAt || now - drawnAt < 1000 * DATA.reload_s || works || unsaved()) return;
    if (touched) location.replace(place());
    location.reload();
  }, 250);
}

/** How often in this window the page was loaded in one state of the training; 0 where the browser stores nothing. */
function reloads() {
  try {
    const [training, times] = JSON.parse(sessionStorage.getItem(KEY) ?? "[]");
    const count = training === DATA.training ? times + 1 : 1;
    sessionStorage.setItem(KEY, JSON.stringify([DATA.training, count]));
    return count;
  } catch {
    return 0;
  }
}

/** Whether something would be lost with the page. */
const unsaved = () => state.path.length > 0 || !correctionsSaved;

/** What `recall` reads: the place where the person is. */
function place() {
  const name = (choice) => (choice === PHOTO ? PHOTO : DATA.models[choice].label);
  const words = new URLSearchParams({ left: name(state.left), right: name(state.right), mode: state.mode, cut: state.cut.toFixed(1) });
  for (const key of ["masks", "frusta"]) words.set(key, state[key] ? "1" : "0");
  if (state.view !== null) words.set("view", DATA.views[state.view].name);
  else for (const [key, point] of [["eye", camera.position], ["to", controls.target]]) words.set(key, point.toArray().join());
  if (state.view === null && state.lens !== undefined) words.set("lens", DATA.views[state.lens].name);
  return `#${words}`;
}

/** `#left=NAME&right=NAME&mode=cut&view=NAME` opens the page there; what is not known is ignored.
 * A free camera stands at `eye=X,Y,Z`, looks `to=X,Y,Z` and is as wide as the photo `lens=NAME`. */
function recall() {
  const words = new URLSearchParams(location.hash.slice(1));
  const changes = {};
  const numbers = (key) => (words.get(key) ?? "").split(",").map(Number).filter(Number.isFinite);
  for (const side of ["left", "right"]) {
    const index = DATA.models.findIndex((m) => m.label === words.get(side));
    if (index >= 0) changes[side] = index;
    else if (words.get(side) === PHOTO) changes[side] = PHOTO;
  }
  if (changes.left === state.right && changes.right === undefined) changes.right = state.left; // never one beside itself
  if (["single", "beside", "cut"].includes(words.get("mode"))) changes.mode = words.get("mode");
  for (const key of ["masks", "frusta"]) if (words.has(key)) changes[key] = words.get(key) === "1";
  if (words.has("cut")) changes.cut = Math.min(Math.max(Number(words.get("cut")) || 0, 0), 100);
  const [view, lens] = ["view", "lens"].map((key) => DATA.views.findIndex((v) => v.name === words.get(key)));
  const [eye, to] = [numbers("eye"), numbers("to")];
  if (view >= 0) changes.view = view;
  else if (eye.length === 3 && to.length === 3) {
    camera.up.set(...DATA.up);
    camera.position.set(...eye);
    controls.target.set(...to);
    changes.view = null;
    if (lens >= 0) changes.lens = lens;
  }
  return choose(changes);
}

async function start() {
  const models = DATA.models.map((m, i) => [String(i), typeof m.mean === "number" && !DATA.mixed ? `${m.label} (${shown(m.mean)} dB)` : m.label]);
  for (const side of ["left", "right"]) fill($(side), [...models, [PHOTO, "the photo"]]);
  fill($("view"), [["", "free"], ...DATA.views.map((v, i) => [String(i), `${v.split}: ${v.name}`])]);
  $("training").textContent = DATA.training;
  $("notes").replaceChildren(...DATA.notes.map((note) => h("li", {}, note)));
  $("chart").hidden = !DATA.map;
  $("correct").hidden = !DATA.models.some((m) => Object.keys(m.masks).length);
  $("map").style.backgroundImage = `url(${DATA.map})`;
  busy("starting");
  R = await loadRenderer();
  T = R.THREE;
  camera = new T.PerspectiveCamera();
  camera.up.set(...DATA.up);
  controls = new R.OrbitControls(camera, $("touch"));
  controls.minDistance = 0.01 * DATA.extent;
  controls.maxDistance = 50 * DATA.extent;
  over = new Pane(R, $("over"), dirty);
  under = new Pane(R, $("under"), dirty);
  listen();
  await recallCorrections();
  await recall();
  if (DATA.reload_s) keepUp();
  requestAnimationFrame(loop);
}

start().catch((error) => busy(`this browser cannot show the models: ${error.message} (WebGL 2 is needed)`));

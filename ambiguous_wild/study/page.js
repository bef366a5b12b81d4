"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const SLOT = "aw-study:" + data.study;
const TEXTS = {
  preference: "Which image is better?",
  preferenceTruth: "Which image, A or B, is closer to the photo?",
  ambiguity: "How hard is it to tell the moving object from the scene?",
};
const SCALE = [
  ["1", "1", "easy to see"], ["2", "2", ""], ["3", "3", "needs a closer look"], ["4", "4", ""],
  ["5", "5", "looks like the scene"], ["none", "0", "I see no moving object"],
];

// --- storage: answers survive a closed tab ------------------------------------------------------------------
let keeps = true;
let state = load();
function load() {
  try {
    const found = JSON.parse(localStorage.getItem(SLOT));
    if (found && typeof found.rater === "string" && found.answers && typeof found.answers === "object")
      return { ...fresh(), ...found };
  } catch (error) { /* no storage, or not our data: start again */ }
  return fresh();
}
function fresh() {
  const bytes = crypto.getRandomValues(new Uint8Array(6));
  const rater = Array.from(bytes, (b) => b.toString(16).padStart(2, "0")).join("");
  // spent: ms on a question so far; opened: questions whose outline was shown.
  return { rater, name: "", answers: {}, spent: {}, opened: {} };
}
function keep() {
  try { localStorage.setItem(SLOT, JSON.stringify(state)); keeps = true; } catch (error) { keeps = false; }
}

// --- order: random per rater, and always the same for one rater ---------------------------------------------
function generator(text) {
  let h = 2166136261; // FNV-1a into mulberry32
  for (const c of text) h = Math.imul(h ^ c.charCodeAt(0), 16777619);
  return () => {
    h = (h + 0x6d2b79f5) | 0;
    let t = Math.imul(h ^ (h >>> 15), 1 | h);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}
let order = [];
function arrange() {
  const random = generator(data.study + state.rater);
  order = [];
  for (const kind of ["ambiguity", "preference"]) {
    const part = data.questions.filter((q) => q.kind === kind);
    for (let i = part.length - 1; i > 0; i--) {
      const j = Math.floor(random() * (i + 1));
      [part[i], part[j]] = [part[j], part[i]];
    }
    for (const q of part) order.push({ ...q, left: random() < 0.5 ? "x" : "y" });
  }
}

// --- questions ---------------------------------------------------------------------------------------------
let index = 0;
let since = 0;
let dirty = false;
const answered = () => order.filter((q) => q.id in state.answers).length;
function firstOpen() {
  const i = order.findIndex((q) => !(q.id in state.answers));
  return i < 0 ? order.length : i;
}
/** The time on a question counts from visit to visit: who comes back has already looked. */
function spend() {
  const q = order[index];
  if (!q || $("ask").hidden) return 0;
  const before = Number(state.spent?.[q.id]) || 0;
  const spent = before + Math.round(performance.now() - since);
  state.spent = { ...state.spent, [q.id]: spent };
  since = performance.now();
  return spent;
}
function show(name) {
  for (const id of ["intro", "ask", "done"]) $(id).hidden = id !== name;
}
function picture(token, caption, kind) {
  const figure = document.createElement("figure");
  if (kind) figure.className = kind;
  const img = document.createElement("img");
  img.src = data.images[token];
  img.alt = caption;
  img.tabIndex = 0;
  img.addEventListener("click", () => zoom(img.src));
  img.addEventListener("keydown", (e) => { if (e.key === "Enter") { e.stopPropagation(); zoom(img.src); } });
  const label = document.createElement("figcaption");
  label.className = "caption";
  label.textContent = caption;
  figure.append(label, img);
  return figure;
}
function choice(value, text, key, small, chosen) {
  const button = document.createElement("button");
  button.dataset.value = value;
  button.setAttribute("aria-pressed", String(chosen === value));
  button.append(text);
  if (key !== text) { const k = document.createElement("kbd"); k.textContent = key; button.append(" ", k); }
  const note = document.createElement("small");
  note.textContent = small || "\u00a0";
  button.append(note);
  button.addEventListener("click", () => answer(value));
  return button;
}
function ask() {
  if (index >= order.length) return finish();
  const q = order[index];
  const right = q.left === "x" ? "y" : "x";
  const given = state.answers[q.id];
  const chosen = given && given.answer;
  show("ask");
  $("pictures").replaceChildren();
  $("choices").replaceChildren();
  $("outline").hidden = !q.images.outline;
  $("outline").setAttribute("aria-pressed", "false");
  if (q.kind === "preference") {
    $("question").textContent = q.images.truth ? TEXTS.preferenceTruth : TEXTS.preference;
    $("pictures").append(picture(q.images[q.left], "A"), picture(q.images[right], "B"));
    if (q.images.truth) $("pictures").append(picture(q.images.truth, "photo", "truth"));
    $("choices").append(
      choice(q.left, "A", "\u2190", "is better", chosen),
      choice("tie", "same", "\u2193", "no difference", chosen),
      choice(right, "B", "\u2192", "is better", chosen));
  } else {
    $("question").textContent = TEXTS.ambiguity;
    $("pictures").append(picture(q.images.photo, "photo", "only"));
    for (const [value, key, small] of SCALE) $("choices").append(choice(value, key, key, small, chosen));
  }
  const count = answered();
  $("count").textContent = (index + 1) + " of " + order.length;
  const bar = document.querySelector(".bar");
  bar.setAttribute("aria-valuemax", String(order.length));
  bar.setAttribute("aria-valuenow", String(count));
  bar.firstElementChild.style.width = (100 * count / order.length) + "%";
  $("back").disabled = index === 0;
  layOut();
  since = performance.now();
}
/** As many columns as make the pictures largest in this window; a phone held upright has its own layout. */
function layOut() {
  const box = $("pictures"), figures = [...box.children], first = box.querySelector("img");
  const phone = matchMedia("(max-width: 720px) and (orientation: portrait)").matches;
  if (phone || !first) { box.style.gridTemplateColumns = ""; return; }
  if (!first.naturalWidth) { first.addEventListener("load", layOut, { once: true }); return; }
  const ratio = first.naturalWidth / first.naturalHeight, caption = 30, gap = 10;
  const width = (columns) => {
    const rows = Math.ceil(figures.length / columns);
    const across = (box.clientWidth - gap * (columns + 1)) / columns;
    return Math.min(across, ratio * ((box.clientHeight - gap * (rows - 1)) / rows - caption));
  };
  const best = figures.map((_, i) => i + 1).sort((a, b) => width(b) - width(a) || b - a)[0];
  box.style.gridTemplateColumns = `repeat(${best}, 1fr)`;
}
function answer(value) {
  const q = order[index];
  const entry = { answer: value, ms: spend() };
  if (q.kind === "preference") entry.left = q.left;
  if (q.images.outline) entry.outline = Boolean(state.opened?.[q.id]);
  state.answers[q.id] = entry;
  dirty = true;
  keep();
  index += 1;
  // After a correction continue at the first open question.
  if (index < order.length && order[index].id in state.answers) index = firstOpen();
  ask();
}
function outline() {
  const q = order[index];
  const on = $("outline").getAttribute("aria-pressed") !== "true";
  $("outline").setAttribute("aria-pressed", String(on));
  if (on) { state.opened = { ...state.opened, [q.id]: true }; keep(); }
  document.querySelector("#pictures img").src = data.images[on ? q.images.outline : q.images.photo];
}
function zoom(source) {
  $("zoom").firstElementChild.src = source;
  $("zoom").showModal();
}

// --- saving ------------------------------------------------------------------------------------------------
function rows() {
  return order.filter((q) => q.id in state.answers).map((q) => ({ question: q.id, ...state.answers[q.id] }));
}
function asJson() {
  const file = { format: "aw-study-answers", version: 1, study: data.study, rater: state.rater, name: state.name,
    asked: order.length, saved: new Date().toISOString(), answers: rows() };
  return JSON.stringify(file, null, 1) + "\n";
}
function asCsv() {
  // Spreadsheets evaluate a cell that starts with a formula character.
  const cell = (v) => {
    const s = String(v === undefined ? "" : v).replace(/^(\s*[=+\-@])/, "'$1");
    return '"' + s.replace(/"/g, '""') + '"';
  };
  const lines = [["study", "rater", "name", "question", "answer", "left", "ms", "outline"]];
  for (const r of rows()) lines.push([data.study, state.rater, state.name, r.question, r.answer, r.left, r.ms,
    r.outline === undefined ? "" : r.outline ? "yes" : "no"]);
  return lines.map((line) => line.map(cell).join(",")).join("\n") + "\n";
}
function save(text, suffix, type) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type }));
  link.download = "answers-" + data.study + "-" + state.rater + suffix;
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  dirty = false;
  $("saved").textContent = "Saved as " + link.download + ". Send this file to the organiser.";
}
function finish() {
  show("done");
  const count = answered();
  const all = count === order.length;
  $("thanks").textContent = all ? "Thank you, that was all." : "Thank you so far.";
  $("state").textContent = all
    ? "Save your answers to a file and send it to the organiser."
    : count + " of " + order.length + " questions are answered. You can save these, or go on" +
      (keeps ? ", now or another day on this device." : ".");
  $("resume").hidden = all && order.length === 0;
  $("saved").textContent = "";
  $("text").hidden = true;
  $("json").disabled = $("csv").disabled = $("show").disabled = count === 0;
}

// --- wiring ------------------------------------------------------------------------------------------------
function intro() {
  const count = (kind) => data.questions.filter((q) => q.kind === kind).length;
  const photos = count("ambiguity"), pairs = count("preference");
  document.title = data.title;
  document.querySelector(".title").textContent = data.title;
  $("what").textContent = data.questions.length + " questions, about " +
    Math.max(1, Math.round(data.questions.length * 8 / 60)) + " minutes.";
  const lines = [];
  if (photos) lines.push("Photos of a static scene with a moving object: rate how hard it is to tell the object from the scene.");
  if (pairs) lines.push("Two rendered images of the same scene: choose the better one, or no difference.");
  lines.push("Answer with the buttons or keys. Click an image to see it at full size.");
  lines.push("You can go back, or stop and continue later.");
  $("how").replaceChildren(...lines.map((t) => Object.assign(document.createElement("li"), { textContent: t })));
  const begun = Object.keys(state.answers).length > 0;
  $("start").textContent = begun ? "Go on (" + answered() + " of " + order.length + " answered)" : "Start";
  $("anew").hidden = !begun;
  $("name").value = state.name;
  $("memory").hidden = keeps;
  show("intro");
}
$("start").addEventListener("click", () => { state.name = $("name").value.trim(); keep(); index = firstOpen(); ask(); });
$("anew").addEventListener("click", () => {
  if (!confirm("This forgets the answers given here. Have they been saved to a file?")) return;
  state = fresh(); dirty = false; keep(); arrange(); intro();
});
$("name").addEventListener("keydown", (e) => { if (e.key === "Enter" && !e.isComposing) { e.preventDefault(); $("start").click(); } });
$("back").addEventListener("click", () => { if (index > 0) { spend(); keep(); index -= 1; ask(); } });
$("outline").addEventListener("click", outline);
$("pause").addEventListener("click", () => { spend(); keep(); finish(); });
$("resume").addEventListener("click", () => { index = Math.min(firstOpen(), order.length - 1); ask(); });
$("json").addEventListener("click", () => save(asJson(), ".json", "application/json"));
$("csv").addEventListener("click", () => save(asCsv(), ".csv", "text/csv"));
$("show").addEventListener("click", () => { $("text").hidden = false; $("text").value = asJson(); $("text").select(); });
$("zoom").addEventListener("click", () => $("zoom").close());
addEventListener("resize", layOut);
addEventListener("beforeunload", (e) => { if (dirty && !keeps) e.preventDefault(); });
addEventListener("keydown", (e) => {
  if ($("ask").hidden || $("zoom").open || e.repeat || e.ctrlKey || e.metaKey || e.altKey) return;
  const keys = { ArrowLeft: 0, ArrowDown: 1, ArrowRight: 2 };
  const buttons = $("choices").children;
  const scale = order[index].kind === "ambiguity";
  let hit = scale ? SCALE.findIndex((s) => s[1] === e.key) : keys[e.key] ?? -1;
  if (hit >= 0) { e.preventDefault(); answer(buttons[hit].dataset.value); }
  else if (e.key === "Backspace") { e.preventDefault(); $("back").click(); }
  else if (e.key === "m" && !$("outline").hidden) outline();
});
arrange();
keep();
intro();

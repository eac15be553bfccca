// The page: classes, photos, tools and keys around the canvas.

import { $, ask } from "/ask.js";
import { Canvas } from "/canvas.js";
import { Drawing } from "/drawing.js";

const state = { tool: "brush", label: "", width: 12, colors: new Map(), opacity: 0.55, maskShown: true };
const photos = []; // {stem, name, width, height, strokes, drawing, image, mask}
let classes = [], current = null, busy = false;
const canvas = new Canvas($("canvas"), state, refresh);

// ---- talking to the server

const address = (kind, photo) => `/${kind}/${encodeURIComponent(photo.stem)}`;

// One job at a time; what it says, or what went wrong, is shown at the foot of the page.
async function work(text, job) {
  if (busy) return;
  busy = true;
  say(text, "busy");
  refresh();
  try {
    say(await job() || "");
  } catch (error) {
    say(error.message, "bad");
  }
  busy = false;
  refresh();
}

function say(text, kind = "") {
  $("status").textContent = text;
  $("status").className = kind;
}

async function saveAll() {
  let files = 0;
  for (const photo of photos.filter(photo => photo.drawing?.dirty)) {
    const { drawing } = photo, { shapes } = drawing;
    await ask(address("strokes", photo), { shapes, imageWidth: photo.width, imageHeight: photo.height });
    drawing.saved = shapes;
    files += 1;
  }
  return files ? `Saved the strokes of ${files} ${files > 1 ? "photos" : "photo"}.` : "Everything is saved.";
}

const save = () => work("Saving …", saveAll);

const run = () => work("Learning from the strokes …", async () => {
  const photo = current, started = performance.now();
  await saveAll();
  photo.mask = await ask(address("try", photo), {});
  state.maskShown = true;
  if (photo === current) canvas.show(photo.drawing, photo.image, photo.mask, true);
  return `Done in ${((performance.now() - started) / 1000).toFixed(0)} s. Draw where it is wrong, and run again.`;
});

const open = photo => work("Loading …", async () => {
  canvas.finish();
  current = photo;
  photo.drawing ??= new Drawing(photo, (await ask(address("strokes", photo))).shapes);
  photo.image ??= await ask(address("photo", photo));
  for (const other of photos) if (other !== photo) other.image = null; // photos are large
  canvas.show(photo.drawing, photo.image, photo.mask);
});

// ---- what is pressed, shown and counted

function choose(tool) {
  canvas.finish();
  state.tool = tool;
  refresh();
}

function pick(label) {
  canvas.finish();
  state.label = label;
  if (["erase", "move"].includes(state.tool)) state.tool = "brush";
  refresh();
}

function setWidth(width) {
  state.width = Math.min(+$("width").max, Math.max(1, Math.round(width)));
  $("width").value = state.width;
  $("width-shown").value = `${state.width} px`;
  canvas.redraw();
}

function step(forth) {
  if (canvas.draft) canvas.cancel();
  else if (forth ? current?.drawing?.redo() : current?.drawing?.undo()) refresh();
}

function showMask(shown) {
  state.maskShown = shown;
  refresh();
}

function turn(by) {
  const next = photos[photos.indexOf(current) + by];
  if (next) open(next);
}

function refresh() {
  for (const button of document.querySelectorAll("[data-tool]")) button.setAttribute("aria-pressed", button.dataset.tool === state.tool);
  document.querySelectorAll("#classes button").forEach((button, index) => button.setAttribute("aria-pressed", classes[index].name === state.label));
  document.querySelectorAll("#photos button").forEach((button, index) => {
    const photo = photos[index], count = photo.drawing ? photo.drawing.shapes.length : photo.strokes, mark = button.querySelector("small");
    button.setAttribute("aria-pressed", photo === current);
    mark.textContent = `${count || ""}${photo.drawing?.dirty ? " ●" : ""}`;
    mark.className = photo.drawing?.dirty ? "dirty" : "";
    mark.title = photo.drawing?.dirty ? "not saved yet" : "";
  });
  const drawing = current?.drawing;
  $("undo").disabled = !drawing?.past.length;
  $("redo").disabled = !drawing?.future.length;
  $("run").disabled = $("save").disabled = busy || !drawing;
  $("mask-panel").hidden = !current?.mask;
  $("toggle").textContent = state.maskShown ? "Hide" : "Show";
  $("canvas").style.cursor = state.tool === "move" || canvas.space ? "grab" : state.tool === "erase" ? "pointer" : "crosshair";
  canvas.redraw();
}

function entry(list, name, color, key, action) {
  const button = document.createElement("button"), text = document.createElement("span"), item = document.createElement("li");
  button.type = "button";
  text.textContent = name;
  if (color) {
    const chip = document.createElement("i");
    chip.style.setProperty("--color", color);
    button.append(chip);
  }
  button.append(text);
  const last = document.createElement(color ? "kbd" : "small");
  last.textContent = key;
  if (key || !color) button.append(last);
  button.addEventListener("click", action);
  item.append(button);
  list.append(item);
}

// ---- keys

const KEYS = {
  b: () => choose("brush"), p: () => choose("polygon"), e: () => choose("erase"), v: () => choose("move"),
  f: () => canvas.fit(), r: run, m: () => showMask(!state.maskShown),
  "[": () => setWidth(Math.min(state.width - 1, state.width / 1.2)), "]": () => setWidth(Math.max(state.width + 1, state.width * 1.2)),
  ",": () => turn(-1), ".": () => turn(1), "+": () => canvas.zoom(1.25), "=": () => canvas.zoom(1.25), "-": () => canvas.zoom(0.8),
  escape: () => canvas.cancel(),
};

document.addEventListener("keydown", event => {
  const key = event.key.toLowerCase(), onButton = event.target.closest("button, input");
  if (event.ctrlKey || event.metaKey) {
    const action = { s: save, z: () => step(event.shiftKey), y: () => step(true) }[key];
    if (!action) return;
    event.preventDefault();
    action();
  } else if (key === " " && !onButton) {
    event.preventDefault();
    canvas.space = true;
    refresh();
  } else if (/^[0-9]$/.test(key)) {
    const chosen = key === "0" ? classes.at(-1) : classes.slice(0, -1)[key - 1];
    if (chosen) pick(chosen.name);
  } else if (!event.altKey && KEYS[key]) {
    event.preventDefault();
    KEYS[key]();
  }
});
document.addEventListener("keyup", event => {
  if (event.key !== " " || !canvas.space) return;
  canvas.space = false;
  refresh();
});
window.addEventListener("beforeunload", event => { if (photos.some(photo => photo.drawing?.dirty)) event.preventDefault(); });

// ---- start

for (const button of document.querySelectorAll("[data-tool]")) button.addEventListener("click", () => choose(button.dataset.tool));
const CLICKS = {
  undo: () => step(false), redo: () => step(true), in: () => canvas.zoom(1.25), out: () => canvas.zoom(0.8), fit: () => canvas.fit(), save, run,
  toggle: () => showMask(!state.maskShown),
};
for (const [id, action] of Object.entries(CLICKS)) $(id).addEventListener("click", action);
$("width").addEventListener("input", event => setWidth(+event.target.value));
$("opacity").addEventListener("input", event => {
  state.opacity = event.target.value / 100;
  $("opacity-shown").value = `${event.target.value} %`;
  canvas.redraw();
});

work("Loading …", async () => {
  const scene = await ask("/scene");
  $("scene").textContent = document.title = scene.scene;
  classes = scene.classes;
  photos.push(...scene.photos);
  classes.forEach(({ name, color }, index) => {
    state.colors.set(name, `rgb(${color.join(" ")})`);
    const last = index === classes.length - 1;
    entry($("classes"), last ? "background" : name, state.colors.get(name), last ? "0" : index < 9 ? `${index + 1}` : "", () => pick(name));
  });
  for (const photo of photos) entry($("photos"), photo.name, "", "", () => open(photo));
  state.label = classes[0].name;
  $("width").max = Math.max(40, Math.round(Math.max(...photos.map(({ width, height }) => Math.max(width, height))) / 16));
  setWidth(Math.max(...photos.map(({ width, height }) => Math.max(width, height))) / 130);
  const asked = scene.start;
  setTimeout(() => open(photos.find(photo => photo.stem === asked) || photos[0]));
});

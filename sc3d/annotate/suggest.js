// The page that asks: one place at a time, outlined in a photo; a key answers.

import { $, ask } from "/ask.js";

const canvas = $("canvas"), context = canvas.getContext("2d");
const AROUND = 5; // sizes of the place that are shown around it
let now = null, image = null, stem = "", wide = false, busy = false;

// One request at a time; what is pressed meanwhile says nothing.
async function go(path, content) {
  if (busy) return;
  busy = true;
  document.body.dataset.busy = "yes";
  await take(path, content).catch(async error => {
    if (error.status === 409) await take("/question").catch(() => {}); // what is asked now
    $("status").textContent = error.message;
    $("status").className = "bad";
  });
  busy = false;
  document.body.dataset.busy = "no";
}

async function take(path, content) {
  const before = now?.place;
  now = await ask(path, content);
  if (now.place !== null && now.stem !== stem) {
    image = await ask(`/photo/${encodeURIComponent(now.stem)}`);
    stem = now.stem;
  }
  wide = wide && now.place === before;
  show();
}

const answer = name => { if (now?.place != null) go("/answer", { place: now.place, class: name }); };
const skip = () => { if (now?.place != null) go("/skip", { place: now.place }); };
const undo = () => go("/undo", {});

function show() {
  $("status").className = "";
  $("status").textContent = now.line;
  const done = now.place === null;
  $("question").textContent = done
    ? "Nothing is left to ask. Run sc3d propagate to use the answers."
    : `${now.points} points, most labelled ${now.label}${now.rival ? `, some views say ${now.rival}` : ""} · ${now.name}`;
  $("undo").disabled = !now.own;
  $("skip").disabled = $("wide").disabled = done;
  $("wide").setAttribute("aria-pressed", wide);
  const list = $("classes");
  list.replaceChildren();
  now.classes.forEach(({ name, color }, index) => entry(list, name, `rgb(${color.join(" ")})`, index < 9 ? `${index + 1}` : "", () => answer(name), done));
  entry(list, "none of them", "transparent", "0", () => answer(null), done);
  draw();
}

function entry(list, name, color, key, action, off) {
  const item = document.createElement("li"), button = document.createElement("button"), chip = document.createElement("i");
  const text = document.createElement("span"), mark = document.createElement("kbd");
  button.type = "button";
  button.disabled = off;
  chip.style.setProperty("--color", color);
  text.textContent = name;
  mark.textContent = key;
  button.append(chip, text, ...(key ? [mark] : []));
  button.addEventListener("click", action);
  item.append(button);
  list.append(item);
}

// The part of the photo that is shown: the place and what is around it, or all.
function frame() {
  const points = now.outline.flat(), xs = points.map(([x]) => x), ys = points.map(([, y]) => y);
  if (wide || !points.length) return [0, 0, now.width, now.height];
  const size = AROUND * Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys), now.width / 80);
  return [(Math.max(...xs) + Math.min(...xs) - size) / 2, (Math.max(...ys) + Math.min(...ys) - size) / 2, size, size];
}

function draw() {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.round(canvas.clientWidth * ratio);
  canvas.height = Math.round(canvas.clientHeight * ratio);
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, canvas.width, canvas.height);
  if (!now || now.place === null || !image) return;
  const [left, top, width, height] = frame(), scale = Math.min(canvas.width / width, canvas.height / height);
  context.setTransform(scale, 0, 0, scale, (canvas.width - scale * width) / 2 - scale * left, (canvas.height - scale * height) / 2 - scale * top);
  context.drawImage(image, 0, 0, now.width, now.height);
  const path = new Path2D();
  for (const ring of now.outline) {
    ring.forEach(([x, y], index) => index ? path.lineTo(x + 0.5, y + 0.5) : path.moveTo(x + 0.5, y + 0.5));
    path.closePath();
  }
  for (const [color, line] of [["#000", 5], ["#ff00c8", 2.5]]) { // shows on everything
    Object.assign(context, { strokeStyle: color, lineWidth: line * ratio / scale, lineJoin: "round" });
    context.stroke(path);
  }
}

function toggle() {
  wide = !wide;
  $("wide").setAttribute("aria-pressed", wide);
  draw();
}

document.addEventListener("keydown", event => {
  const key = event.key.toLowerCase();
  if (event.altKey || event.repeat) return;
  if (event.ctrlKey || event.metaKey) {
    if (key !== "z") return;
    event.preventDefault();
    undo();
  } else if (/^[0-9]$/.test(key)) {
    if (key === "0") answer(null);
    else if (now?.classes[key - 1]) answer(now.classes[key - 1].name);
  } else if (key === "s") skip();
  else if (key === "f" && now?.place != null) toggle();
});
$("undo").addEventListener("click", undo);
$("skip").addEventListener("click", skip);
$("wide").addEventListener("click", toggle);
document.addEventListener("visibilitychange", () => { if (!document.hidden && now) go("/question"); }); // others may have answered
new ResizeObserver(draw).observe(canvas);

ask("/scene").then(scene => { $("scene").textContent = document.title = scene.scene; return go("/question"); })
  .catch(error => { $("status").textContent = error.message; $("status").className = "bad"; });

// The photo with mask and strokes, and what mouse, pen and arrow keys do on it.

import { isArea, outline, rounded, simplify } from "/drawing.js";

const CLOSE = 9; // px on the screen within which a click means a point

export class Canvas {
  constructor(element, state, changed) {
    this.element = element;
    this.context = element.getContext("2d");
    this.state = state; // {tool, label, width, colors, opacity, maskShown}
    this.changed = changed; // called after the drawing has changed
    this.view = { x: 0, y: 0, scale: 1 }; // screen px = view + scale * photo px
    this.draft = null; // a stroke or polygon being drawn: {shape_type, points}
    this.pointer = null; // place in the photo that the mouse or the cross is at
    this.cross = false; // the place is moved by keys
    this.dragged = null;
    this.space = false;
    new ResizeObserver(() => this.#resized()).observe(element);
    element.addEventListener("pointerdown", event => this.#down(event));
    element.addEventListener("pointermove", event => this.#move(event));
    element.addEventListener("pointerup", event => this.#up(event));
    element.addEventListener("pointercancel", () => this.cancel());
    element.addEventListener("pointerleave", () => { if (!this.draft && !this.cross) this.#point(null); });
    element.addEventListener("dblclick", () => this.finish());
    element.addEventListener("contextmenu", event => event.preventDefault());
    element.addEventListener("wheel", event => this.#wheel(event), { passive: false });
    element.addEventListener("keydown", event => this.#key(event));
  }

  show(drawing, image, mask, keepView) {
    Object.assign(this, { drawing, image, mask, draft: null, cross: false });
    if (keepView) this.redraw(); else this.fit();
  }

  fit() {
    const { clientWidth, clientHeight } = this.element, { width, height } = this.drawing.photo;
    this.fitted = true;
    const scale = Math.min(clientWidth / width, clientHeight / height) * 0.97;
    this.view = { scale, x: (clientWidth - scale * width) / 2, y: (clientHeight - scale * height) / 2 };
    this.redraw();
  }

  zoom(factor, at = [this.element.clientWidth / 2, this.element.clientHeight / 2]) {
    const scale = Math.min(40, Math.max(0.02, this.view.scale * factor)), ratio = scale / this.view.scale;
    this.fitted = false;
    this.view = { scale, x: at[0] - (at[0] - this.view.x) * ratio, y: at[1] - (at[1] - this.view.y) * ratio };
    this.redraw();
  }

  finish() {
    const draft = this.draft;
    if (!draft) return;
    this.draft = null;
    const points = rounded(draft.shape_type === "polygon" ? draft.points : simplify(draft.points, Math.max(0.5, 0.7 / this.view.scale)));
    const distinct = points.filter((point, index) => !index || point.join() !== points[index - 1].join());
    if (draft.shape_type !== "polygon") {
      this.drawing.add({ label: this.state.label, shape_type: "linestrip", points: distinct, width: this.state.width });
    } else if (distinct.length > 2) {
      this.drawing.add({ label: this.state.label, shape_type: "polygon", points: distinct });
    }
    this.changed();
  }

  cancel() {
    this.draft = this.dragged = null;
    this.redraw();
  }

  redraw() {
    if (!this.pending) this.pending = requestAnimationFrame(() => { this.pending = 0; this.#draw(); });
  }

  #resized() {
    const ratio = window.devicePixelRatio || 1;
    this.element.width = Math.round(this.element.clientWidth * ratio);
    this.element.height = Math.round(this.element.clientHeight * ratio);
    if (this.drawing) this.fitted ? this.fit() : this.redraw();
  }

  #place(event) { return [(event.offsetX - this.view.x) / this.view.scale, (event.offsetY - this.view.y) / this.view.scale]; }

  #clamped([x, y]) { return [Math.min(this.drawing.photo.width, Math.max(0, x)), Math.min(this.drawing.photo.height, Math.max(0, y))]; }

  #point(place) {
    this.pointer = place;
    this.redraw();
  }

  #down(event) {
    if (!this.drawing) return;
    this.element.focus({ preventScroll: true });
    this.element.setPointerCapture(event.pointerId);
    this.cross = false;
    const place = this.#clamped(this.#place(event));
    if (event.button > 0 || this.space || this.state.tool === "move") this.dragged = [event.offsetX, event.offsetY];
    else if (this.state.tool === "brush") this.draft = { shape_type: "linestrip", points: [place] };
    else if (this.state.tool === "polygon") this.#corner(place);
    else this.#erase(place);
    this.#point(place);
  }

  #move(event) {
    if (!this.drawing) return;
    if (this.dragged) {
      this.fitted = false;
      this.view = { ...this.view, x: this.view.x + event.offsetX - this.dragged[0], y: this.view.y + event.offsetY - this.dragged[1] };
      this.dragged = [event.offsetX, event.offsetY];
    } else if (event.buttons & 1) {
      const place = this.#clamped(this.#place(event));
      if (this.draft?.shape_type === "linestrip") this.draft.points.push(place);
      else if (this.state.tool === "erase") this.#erase(place);
    }
    if (event.buttons || event.movementX || event.movementY) this.cross = false;
    if (!this.cross) this.#point(this.#place(event));
  }

  #up() {
    this.dragged = null;
    if (this.draft?.shape_type === "linestrip" && !this.cross) this.finish();
  }

  #wheel(event) {
    event.preventDefault();
    if (this.drawing) this.zoom(Math.exp(-Math.max(-200, Math.min(200, event.deltaY)) * (event.ctrlKey ? 0.01 : 0.0015)), [event.offsetX, event.offsetY]);
  }

  // Another corner; on the first one, the polygon is closed.
  #corner(place) {
    if (this.draft?.shape_type !== "polygon") { this.draft = { shape_type: "polygon", points: [place] }; return; }
    const [x, y] = this.draft.points[0];
    if (this.draft.points.length > 2 && Math.hypot(place[0] - x, place[1] - y) * this.view.scale < CLOSE) this.finish();
    else this.draft.points.push(place);
  }

  #erase(place) {
    const index = this.drawing.find(place, CLOSE / 2 / this.view.scale);
    if (index < 0) return;
    this.drawing.change(this.drawing.shapes.filter((_, other) => other !== index));
    this.changed();
  }

  #key(event) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!this.drawing || event.ctrlKey || event.metaKey || event.altKey) return;
    if (step) this.#moveCross(step, event.shiftKey ? 40 : 8);
    else if (event.key === "Enter") this.#enter();
    else return;
    event.preventDefault();
  }

  #moveCross(step, far) {
    const { clientWidth, clientHeight } = this.element;
    const middle = [(clientWidth / 2 - this.view.x) / this.view.scale, (clientHeight / 2 - this.view.y) / this.view.scale];
    const place = this.#clamped((this.cross && this.pointer || middle).map((value, axis) => value + step[axis] * far / this.view.scale));
    this.cross = true;
    if (this.draft?.shape_type === "linestrip") this.draft.points.push(place);
    for (const [axis, side, size] of [[0, "x", clientWidth], [1, "y", clientHeight]]) { // keep it in sight
      const shown = this.view[side] + this.view.scale * place[axis];
      this.view[side] -= Math.min(0, shown - 20) + Math.max(0, shown - size + 20);
    }
    this.#point(place);
  }

  #enter() {
    if (!this.cross || !this.pointer) { this.finish(); return; }
    const { tool } = this.state, last = this.draft?.points.at(-1);
    if (tool === "erase") this.#erase(this.pointer);
    else if (tool === "polygon") last && last.join() === this.pointer.join() ? this.finish() : this.#corner(this.pointer); // twice at a place closes
    else if (tool === "brush") this.draft ? this.finish() : this.draft = { shape_type: "linestrip", points: [this.pointer] };
    this.redraw();
  }

  #draw() {
    const { context, view, state } = this, ratio = window.devicePixelRatio || 1;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.element.width, this.element.height);
    if (!this.drawing) return;
    context.setTransform(ratio * view.scale, 0, 0, ratio * view.scale, ratio * view.x, ratio * view.y);
    const { width, height } = this.drawing.photo;
    context.imageSmoothingEnabled = view.scale < 4;
    if (this.image) context.drawImage(this.image, 0, 0, width, height);
    if (this.mask && state.maskShown) {
      context.globalAlpha = state.opacity;
      context.imageSmoothingEnabled = false;
      context.drawImage(this.mask, 0, 0, width, height);
      context.globalAlpha = 1;
    }
    for (const shape of this.drawing.shapes) this.#drawShape(shape, state.colors.get(shape.label));
    if (this.draft) this.#drawDraft(state.colors.get(state.label));
    this.#drawPointer();
  }

  #drawShape(shape, color) {
    const { context } = this, line = 1.5 / this.view.scale;
    const path = new Path2D();
    outline(shape).forEach(([x, y], index) => index ? path.lineTo(x, y) : path.moveTo(x, y));
    Object.assign(context, { lineCap: "round", lineJoin: "round", strokeStyle: color, fillStyle: color });
    if (isArea(shape)) {
      path.closePath();
      context.globalAlpha = 0.5;
      if (shape.shape_type !== "mask") context.fill(path); // whose pixels are not the whole box
      context.globalAlpha = 1;
      context.lineWidth = line;
      context.stroke(path);
      return;
    }
    if (shape.points.length === 1) path.lineTo(shape.points[0][0] + 1e-3, shape.points[0][1]);
    context.lineWidth = this.drawing.widthOf(shape);
    context.globalAlpha = 0.75;
    context.stroke(path);
    context.globalAlpha = 1;
  }

  #drawDraft(color) {
    const { draft, context } = this, points = this.pointer && draft.shape_type === "polygon" ? [...draft.points, this.#clamped(this.pointer)] : draft.points;
    this.#drawShape({ ...draft, points, width: this.state.width }, color);
    if (draft.shape_type !== "polygon") return;
    context.fillStyle = color;
    for (const [x, y] of draft.points) context.fillRect(x - 3 / this.view.scale, y - 3 / this.view.scale, 6 / this.view.scale, 6 / this.view.scale);
  }

  // A ring as wide as the brush, in black and white so that it shows on everything; a cross if keys move it.
  #drawPointer() {
    if (!this.pointer) return;
    const { context, view } = this, [x, y] = this.pointer, arm = 9 / view.scale;
    const path = new Path2D();
    if (this.state.tool === "brush") path.arc(x, y, Math.max(this.state.width / 2, 1.5 / view.scale), 0, 2 * Math.PI);
    if (this.cross) for (const [dx, dy] of [[arm, 0], [0, arm]]) { path.moveTo(x - dx, y - dy); path.lineTo(x + dx, y + dy); }
    for (const [color, width] of [["#000", 2.5], ["#fff", 1]]) {
      Object.assign(context, { strokeStyle: color, lineWidth: width / view.scale });
      context.stroke(path);
    }
  }
}

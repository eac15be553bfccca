// The strokes of one photo with their history, and the geometry they need. Coordinates are px of the photo.

const DEFAULT_WIDTH = 0.005; // of strokes that state none, share of the longest side; as in stroke_files.py
const AREAS = new Set(["polygon", "rectangle", "circle", "mask"]);

export class Drawing {
  constructor(photo, shapes) {
    this.photo = photo;
    this.shapes = shapes;
    this.past = [];
    this.future = [];
    this.saved = shapes;
  }

  get dirty() { return this.shapes !== this.saved; }

  change(shapes) {
    this.past.push(this.shapes);
    this.future = [];
    this.shapes = shapes;
  }

  add(shape) { this.change([...this.shapes, shape]); }

  undo() { return this.#step(this.past, this.future); }

  redo() { return this.#step(this.future, this.past); }

  #step(from, to) {
    if (!from.length) return false;
    to.push(this.shapes);
    this.shapes = from.pop();
    return true;
  }

  // The topmost shape at a place, or within `reach` of it; -1 if there is none.
  find([x, y], reach) {
    for (let index = this.shapes.length - 1; index >= 0; index--) {
      const shape = this.shapes[index], points = outline(shape);
      const away = AREAS.has(shape.shape_type) ? (inside(points, x, y) ? 0 : distance([...points, points[0]], x, y))
        : distance(points, x, y) - this.widthOf(shape) / 2;
      if (away <= reach) return index;
    }
    return -1;
  }

  widthOf(shape) { return shape.width || DEFAULT_WIDTH * Math.max(this.photo.width, this.photo.height); }
}

export const isArea = shape => AREAS.has(shape.shape_type);

// The corners of a shape: rectangles, circles and masks of LabelMe state two points only; of a mask, the box is shown.
export function outline(shape) {
  const [[left, top], [right, bottom] = []] = shape.points;
  if (shape.shape_type === "rectangle") return [[left, top], [right, top], [right, bottom], [left, bottom]];
  if (shape.shape_type === "mask") return [[left, top], [right + 1, top], [right + 1, bottom + 1], [left, bottom + 1]];
  if (shape.shape_type === "circle") {
    const radius = Math.hypot(right - left, bottom - top);
    return Array.from({ length: 64 }, (_, index) => [left + radius * Math.cos(index * Math.PI / 32), top + radius * Math.sin(index * Math.PI / 32)]);
  }
  return shape.points;
}

// Leave out points that lie within `tolerance` of the line through those that stay (Douglas and Peucker).
export function simplify(points, tolerance) {
  if (points.length < 3) return points;
  const kept = new Uint8Array(points.length), parts = [[0, points.length - 1]];
  kept[0] = kept[points.length - 1] = 1;
  while (parts.length) {
    const [first, last] = parts.pop();
    let farthest = -1, most = tolerance;
    for (let index = first + 1; index < last; index++) {
      const away = distance([points[first], points[last]], ...points[index]);
      if (away > most) [farthest, most] = [index, away];
    }
    if (farthest > 0) {
      kept[farthest] = 1;
      parts.push([first, farthest], [farthest, last]);
    }
  }
  return points.filter((_, index) => kept[index]);
}

export const rounded = points => points.map(point => point.map(value => Math.round(value * 10) / 10));

function inside(points, x, y) {
  let odd = false;
  for (let index = 0, before = points.length - 1; index < points.length; before = index++) {
    const [ax, ay] = points[index], [bx, by] = points[before];
    if (ay > y !== by > y && x < (bx - ax) * (y - ay) / (by - ay) + ax) odd = !odd;
  }
  return odd;
}

// From a place to the nearest point of a chain of lines.
function distance(points, x, y) {
  let least = Math.hypot(points[0][0] - x, points[0][1] - y);
  for (let index = 1; index < points.length; index++) {
    const [ax, ay] = points[index - 1], [bx, by] = points[index];
    const length = (bx - ax) ** 2 + (by - ay) ** 2;
    const along = length ? Math.min(1, Math.max(0, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length)) : 0;
    least = Math.min(least, Math.hypot(ax + along * (bx - ax) - x, ay + along * (by - ay) - y));
  }
  return least;
}

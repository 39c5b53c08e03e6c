// What the plots have in common: colours, canvases, axes.

// From the best to the worst, dark to light; readable without telling red from green (viridis).
const PALETTE = ["#440154", "#46327e", "#365c8d", "#277f8e", "#1fa187", "#4ac16d", "#a0da39"];
const GREY = "#dcdcdc";
const INK = "#1a1a1a";
const FONT = "12px system-ui, sans-serif";
/** Rows drawn before the time is looked at, and milliseconds of drawing per frame. */
const BLOCK = 400;
const BUDGET = 10;

/** A canvas that fills its element's width, sharp on any screen; its context draws in CSS pixels. */
function fit(canvas, width, height) {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  canvas.style.width = `${width}px`;
  canvas.style.height = `${height}px`;
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.font = FONT;
  return context;
}

/** A picture of a canvas, to draw on top of it again and again. */
class Snapshot {
  constructor() {
    this.picture = document.createElement("canvas");
  }

  take(canvas) {
    this.picture.width = canvas.width;
    this.picture.height = canvas.height;
    this.picture.getContext("2d").drawImage(canvas, 0, 0);
  }

  /** Put it back; false if the canvas has another size since. */
  restore(canvas, context) {
    const { width, height } = this.picture;
    if (width !== canvas.width || height !== canvas.height) return false;
    context.save();
    context.resetTransform();
    context.clearRect(0, 0, width, height);
    context.drawImage(this.picture, 0, 0);
    context.restore();
    return true;
  }
}

/** Where a pointer is on a canvas, in CSS pixels. */
function place(event) {
  const box = event.currentTarget.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

/** Colours of `State.colors`. */
function palette(data) {
  return [...PALETTE, data.colors.failed];
}

/** Draw rows over several frames: `draw` takes a part of them; a newer drawing ends this one. */
function inFrames(owner, rows, draw, onEnd = () => {}) {
  const token = (owner.token = (owner.token ?? 0) + 1);
  let first = 0;
  const frame = () => {
    if (owner.token !== token) return;
    const started = performance.now();
    while (first < rows.length && performance.now() - started < BUDGET) {
      draw(rows.slice(first, first + BLOCK));
      first += BLOCK;
    }
    if (first < rows.length) requestAnimationFrame(frame);
    else onEnd();
  };
  frame();
}

/** Options of a <select>: all columns. */
function fillSelect(select, columns, chosen) {
  for (const column of columns) {
    const option = new Option(column.text, column.index);
    option.selected = column === chosen;
    select.add(option);
  }
}

/** An axis at the left and one at the bottom of a box, with ticks, their texts and names. */
function drawAxes(context, box, across, up, names) {
  const { left, top, width, height } = box;
  context.strokeStyle = "#999";
  context.fillStyle = INK;
  context.lineWidth = 1;
  context.strokeRect(left, top, width, height);
  context.textAlign = "center";
  for (const value of across.ticks(Math.max(2, Math.floor(width / 75)))) {
    const x = left + across.to(value) * width;
    tick(context, x, top + height, x, top + height + 4);
    context.fillText(across.text(value), x, top + height + 17);
  }
  context.textAlign = "right";
  for (const value of up.ticks(Math.max(2, Math.floor(height / 32)))) {
    const y = top + (1 - up.to(value)) * height;
    tick(context, left - 4, y, left, y);
    context.fillText(up.text(value), left - 7, y + 4);
  }
  context.textAlign = "center";
  context.fillText(names[0], left + width / 2, top + height + 34);
  context.textAlign = "left";
  context.fillText(names[1], 2, top - 8);
}

function tick(context, x0, y0, x1, y1) {
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}

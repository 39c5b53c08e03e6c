// Parallel coordinates: one line per case, one axis per column. A drag along an axis brushes it.

class ParallelPlot {
  constructor(state, canvas, columns) {
    Object.assign(this, { state, canvas, columns, drag: null, snapshot: new Snapshot() });
    this.background = document.createElement("canvas");
    canvas.addEventListener("pointerdown", (event) => this.onDown(event));
    canvas.addEventListener("pointermove", (event) => this.onMove(event));
    canvas.addEventListener("pointerup", () => this.onUp());
    canvas.addEventListener("pointercancel", () => this.onUp());
  }

  show(columns) {
    this.columns = columns;
    this.resize();
  }

  resize() {
    const width = Math.max(this.canvas.parentElement.clientWidth, 96 * this.columns.length);
    const height = 330;
    this.context = fit(this.canvas, width, height);
    const behind = fit(this.background, width, height);
    Object.assign(this, { width, height, top: 46, bottom: height - 44 });
    this.place();
    this.strokes(behind, this.state.shuffled, () => GREY, 0.5);
    this.onBrushed();
  }

  /** Where each column's axis is, and where each row meets it. */
  place() {
    const { n } = this.state.data;
    const margin = 52;
    const gap = (this.width - 2 * margin) / Math.max(this.columns.length - 1, 1);
    this.x = this.columns.map((_, k) => margin + k * gap);
    this.y = this.columns.map(({ value, scale }) => {
      const y = new Float32Array(n);
      for (let row = 0; row < n; row++) {
        y[row] = Number.isFinite(value[row]) ? this.yOf(scale, value[row]) : this.bottom + 16;
      }
      return y;
    });
  }

  yOf(scale, value) {
    return this.bottom - scale.to(value) * (this.bottom - this.top);
  }

  /** Lines of rows, those of one colour together. */
  strokes(context, rows, colorOf, alpha) {
    const groups = new Map();
    for (const row of rows) {
      const color = colorOf(row);
      if (!groups.has(color)) groups.set(color, []);
      groups.get(color).push(row);
    }
    context.globalAlpha = alpha;
    context.lineWidth = 1;
    for (const [color, some] of groups) {
      context.strokeStyle = color;
      context.beginPath();
      for (const row of some) {
        context.moveTo(this.x[0], this.y[0][row]);
        for (let k = 1; k < this.x.length; k++) context.lineTo(this.x[k], this.y[k][row]);
      }
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  onBrushed() {
    const { state, context } = this;
    const kept = state.shuffled.filter((row) => state.kept[row]);
    const rows = [true, false].flatMap((isFailed) => [
      ...kept.filter((row) => state.isFailed(row) === isFailed),
    ]); // failures below
    const colors = palette(state.data);
    const alpha = Math.min(0.9, Math.max(0.12, 400 / (rows.length + 1)));
    context.clearRect(0, 0, this.width, this.height);
    context.drawImage(this.background, 0, 0, this.width, this.height);
    const draw = (some) => this.strokes(context, some, (row) => colors[state.colors[row]], alpha);
    this.isDrawing = true;
    inFrames(this, rows, draw, () => {
      this.isDrawing = false;
      this.snapshot.take(this.canvas);
      this.onChosen();
    });
    this.axes();
  }

  onChosen() {
    const { state, context } = this;
    if (this.isDrawing || !this.snapshot.restore(this.canvas, context)) return;
    if (state.chosen >= 0) {
      context.lineWidth = 3;
      this.highlight(state.chosen, "#fff", 5);
      this.highlight(state.chosen, "#d00000", 2);
    }
    this.axes();
  }

  highlight(row, color, width) {
    const { context } = this;
    context.strokeStyle = color;
    context.lineWidth = width;
    context.beginPath();
    this.x.forEach((x, k) => context.lineTo(x, this.y[k][row]));
    context.stroke();
  }

  axes() {
    const { context, state } = this;
    this.columns.forEach((column, k) => {
      const x = this.x[k];
      context.strokeStyle = "#555";
      context.lineWidth = 1;
      tick(context, x, this.top, x, this.bottom);
      this.name(column, k);
      context.textAlign = "right";
      for (const value of column.scale.ticks(6)) {
        const y = this.yOf(column.scale, value);
        tick(context, x - 4, y, x, y);
        outlined(context, column.scale.text(value), x - 6, y + 4);
      }
      const range = state.ranges.get(column.index);
      if (range) this.band(column.scale, x, range);
    });
    context.textAlign = "left";
    outlined(context, "no value", 2, this.bottom + 20);
  }

  /** Name and unit, alternately higher and lower, so that neighbours do not overlap. */
  name(column, k) {
    const { context } = this;
    const isLast = k === this.columns.length - 1;
    context.textAlign = k === 0 ? "left" : isLast ? "right" : "center";
    const x = k === 0 ? 2 : isLast ? this.width - 2 : this.x[k];
    context.fillStyle = INK;
    context.fillText(column.text, x, k % 2 ? 14 : 32);
  }

  band(scale, x, [low, high]) {
    const clamp = (value) => Math.min(Math.max(value, this.top), this.bottom);
    const ends = [high, low].map((value) =>
      clamp(Number.isFinite(value) ? this.yOf(scale, value) : value > 0 ? this.top : this.bottom)
    );
    this.context.fillStyle = "rgba(11, 60, 111, 0.25)";
    this.context.fillRect(x - 8, ends[0], 16, Math.max(ends[1] - ends[0], 2));
    this.context.strokeStyle = "#0b3c6f";
    this.context.strokeRect(x - 8, ends[0], 16, Math.max(ends[1] - ends[0], 2));
  }

  onDown(event) {
    const [x, y] = place(event);
    const distances = this.x.map((at) => Math.abs(at - x));
    const k = distances.indexOf(Math.min(...distances));
    if (distances[k] > 30) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.drag = { k, from: y, to: y };
  }

  onMove(event) {
    if (!this.drag) return;
    this.drag.to = place(event)[1];
    if (Math.abs(this.drag.to - this.drag.from) < 4) return;
    const column = this.columns[this.drag.k];
    const shares = [this.drag.from, this.drag.to].map((y) =>
      Math.min(Math.max((this.bottom - y) / (this.bottom - this.top), -0.001), 1.001)
    );
    this.drag.isRange = true;
    this.state.brush(column, shares.sort((a, b) => a - b).map((x) => column.scale.from(x)));
  }

  onUp() {
    if (this.drag && !this.drag.isRange) this.state.brush(this.columns[this.drag.k], null);
    this.drag = null;
  }
}

/** Text readable on top of lines. */
function outlined(context, text, x, y) {
  context.strokeStyle = "rgba(255, 255, 255, 0.85)";
  context.lineWidth = 3;
  context.strokeText(text, x, y);
  context.fillStyle = INK;
  context.fillText(text, x, y);
  context.strokeStyle = "#555";
  context.lineWidth = 1;
}

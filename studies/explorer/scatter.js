// A scatter plot of any two columns. A drag brushes both, a click chooses the nearest case.

class ScatterPlot {
  constructor(state, panel, across, up) {
    this.state = state;
    this.snapshot = new Snapshot();
    this.canvas = panel.querySelector("canvas");
    this.note = panel.querySelector("p");
    const { columns } = state.data;
    this.selects = ["across", "up"].map((name, k) => {
      const select = panel.querySelector(`select[name=${name}]`);
      fillSelect(select, columns, [across, up][k]);
      select.addEventListener("change", () => this.resize());
      return select;
    });
    this.canvas.addEventListener("pointerdown", (event) => this.onDown(event));
    this.canvas.addEventListener("pointermove", (event) => this.onMove(event));
    this.canvas.addEventListener("pointerup", (event) => this.onUp(event));
    this.canvas.addEventListener("pointercancel", () => (this.drag = null));
  }

  get columns() {
    return this.selects.map((select) => this.state.data.columns[select.value]);
  }

  resize() {
    const width = this.canvas.parentElement.clientWidth;
    const height = 320;
    this.context = fit(this.canvas, width, height);
    this.size = [width, height];
    this.box = { left: 58, top: 24, width: width - 74, height: height - 24 - 58 };
    this.place();
    this.onBrushed();
  }

  /** Pixels of every row; a missing value stands beyond the axis. */
  place() {
    const { left, top, width, height } = this.box;
    const { n } = this.state.data;
    const [across, up] = this.columns;
    this.x = new Float32Array(n);
    this.y = new Float32Array(n);
    for (let row = 0; row < n; row++) {
      const [a, b] = [across.value[row], up.value[row]];
      this.x[row] = Number.isFinite(a) ? left + across.scale.to(a) * width : left + width + 9;
      this.y[row] = Number.isFinite(b) ? top + (1 - up.scale.to(b)) * height : top + height + 43;
    }
  }

  onBrushed() {
    const { context, state } = this;
    const colors = palette(state.data);
    context.clearRect(0, 0, ...this.size);
    const size = state.data.n > 3000 ? 2 : state.data.n > 400 ? 3 : 5;
    context.fillStyle = GREY;
    for (const row of state.shuffled) if (!state.kept[row]) this.dot(row, size);
    const groups = colors.map(() => []);
    for (const row of state.shuffled) if (state.kept[row]) groups[state.colors[row]].push(row);
    for (let k = groups.length - 1; k >= 0; k--) {
      context.fillStyle = colors[k];
      for (const row of groups[k]) this.dot(row, size + 1);
    }
    const [across, up] = this.columns;
    drawAxes(context, this.box, across.scale, up.scale, [across.text, up.text]);
    this.front();
    this.snapshot.take(this.canvas);
    this.onChosen();
  }

  dot(row, size) {
    this.context.fillRect(this.x[row] - size / 2, this.y[row] - size / 2, size, size);
  }

  /** The Pareto front of the brushed cases, where both columns have a better end. */
  front() {
    const { state, context } = this;
    const [across, up] = this.columns;
    this.note.textContent = "";
    if (across === up || !across.better || !up.better) return;
    const rows = paretoFront(state, across, up);
    if (!rows.length) return;
    context.strokeStyle = INK;
    context.lineWidth = 1.5;
    context.beginPath();
    rows.forEach((row, k) => {
      if (k > 0) context.lineTo(this.x[row], this.y[rows[k - 1]]);
      context.lineTo(this.x[row], this.y[row]);
    });
    context.stroke();
    const many = rows.length === 1 ? `1 ${state.data.noun}` : `${rows.length} ${state.data.noun}s`;
    this.note.textContent =
      `Line: Pareto front, ${many} (${across.better} ${across.name}, ${up.better} ${up.name}).`;
  }

  onChosen() {
    const { context, state } = this;
    if (!this.snapshot.restore(this.canvas, context)) return;
    if (state.chosen < 0) return;
    context.strokeStyle = "#d00000";
    context.lineWidth = 2;
    context.beginPath();
    context.arc(this.x[state.chosen], this.y[state.chosen], 7, 0, 2 * Math.PI);
    context.stroke();
  }

  onDown(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.drag = { from: place(event) };
  }

  onMove(event) {
    if (!this.drag) return;
    const to = place(event);
    const isFar = to.some((x, k) => Math.abs(x - this.drag.from[k]) > 6);
    if (!isFar && !this.drag.isRange) return;
    this.drag.isRange = true;
    this.brush(this.drag.from, to);
  }

  brush(from, to) {
    const { left, top, width, height } = this.box;
    const shares = [
      [from[0], to[0]].map((x) => (x - left) / width),
      [from[1], to[1]].map((y) => 1 - (y - top) / height),
    ];
    const [across, up] = this.columns;
    [across, up].forEach((column, k) => {
      const ends = shares[k].sort((a, b) => a - b).map((x) => column.scale.from(x));
      this.state.ranges.set(column.index, ends);
    });
    this.state.changed();
  }

  onUp(event) {
    const drag = this.drag;
    this.drag = null;
    if (!drag || drag.isRange) return;
    const [x, y] = place(event);
    let [nearest, least] = [-1, 15 ** 2];
    for (const row of this.state.keptRows) {
      const away = (this.x[row] - x) ** 2 + (this.y[row] - y) ** 2;
      if (away < least) [nearest, least] = [row, away];
    }
    if (nearest >= 0) this.state.choose(nearest);
  }
}

/** Brushed rows that no other one beats in both columns, ordered by the first. */
function paretoFront(state, across, up) {
  const sign = (column) => (column.better === "largest" ? -1 : 1);
  const [a, b] = [sign(across), sign(up)];
  const rows = state.keptRows.filter(
    (row) => !state.isFailed(row) && Number.isFinite(across.value[row]) && Number.isFinite(up.value[row])
  );
  rows.sort(
    (p, q) => a * (across.value[p] - across.value[q]) || b * (up.value[p] - up.value[q])
  );
  let least = Infinity;
  return rows.filter((row) => {
    const value = b * up.value[row];
    const isBetter = value < least;
    if (isBetter) least = value;
    return isBetter;
  });
}

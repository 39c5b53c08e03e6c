// What is brushed and chosen. Every view draws itself again when this changes.

class State {
  constructor(data) {
    this.data = data;
    this.ranges = new Map(); // index of a column: [lowest, highest value]
    this.hasFailures = true;
    this.kept = new Uint8Array(data.n);
    this.keptRows = [];
    this.chosen = -1;
    this.views = [];
    // Plots draw rows in this order, so that a part of them looks like all of them.
    this.shuffled = shuffle(data.n);
    this.sorted = sortedBy(data, data.columns[data.rank], true);
    this.colors = colorsOf(data, this.sorted);
    for (const column of data.columns) {
      if (column.least !== null) this.ranges.set(column.index, [column.least, Infinity]);
    }
    this.apply();
  }

  /** Keep rows of a column within a range, or all with null. */
  brush(column, range) {
    if (range) this.ranges.set(column.index, range);
    else this.ranges.delete(column.index);
    this.changed();
  }

  clear() {
    this.ranges.clear();
    this.hasFailures = true;
    this.changed();
  }

  choose(row) {
    this.chosen = row;
    for (const view of this.views) view.onChosen?.();
  }

  isFailed(row) {
    return this.data.status[row] !== 0;
  }

  /** Many changes within a frame are drawn once. */
  changed() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = undefined;
      this.apply();
      for (const view of this.views) view.onBrushed?.();
      for (const view of this.views) view.onChosen?.();
    });
  }

  apply() {
    const { columns, status, n } = this.data;
    this.kept.fill(1);
    for (const [index, [low, high]] of this.ranges) {
      const { value } = columns[index];
      for (let row = 0; row < n; row++) {
        if (!(value[row] >= low && value[row] <= high)) this.kept[row] = 0;
      }
    }
    if (!this.hasFailures) {
      for (let row = 0; row < n; row++) if (status[row] !== 0) this.kept[row] = 0;
    }
    this.keptRows = this.sorted.filter((row) => this.kept[row]);
    if (this.chosen < 0 || !this.kept[this.chosen]) this.chosen = this.keptRows[0] ?? -1;
  }
}

/** Rows ordered by a column, failures last. */
function sortedBy(data, column, isForward) {
  const sign = (column.better === "largest" ? -1 : 1) * (isForward ? 1 : -1);
  const { value } = column;
  const key = new Float64Array(data.n);
  for (let row = 0; row < data.n; row++) {
    const isKnown = data.status[row] === 0 && Number.isFinite(value[row]);
    key[row] = isKnown ? sign * value[row] : Infinity;
  }
  return Array.from(key.keys()).sort((a, b) => (key[a] < key[b] ? -1 : key[a] > key[b] ? 1 : a - b));
}

/** Row numbers in an order that looks random and is always the same. */
function shuffle(n) {
  const rows = Uint32Array.from({ length: n }, (_, row) => row);
  let seed = 1;
  for (let k = n - 1; k > 0; k--) {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    const other = Math.floor((seed / 2 ** 32) * (k + 1));
    [rows[k], rows[other]] = [rows[other], rows[k]];
  }
  return rows;
}

/** Number of each row's colour, by its rank; the last one is that of failures. */
function colorsOf(data, sorted) {
  const colors = new Uint8Array(data.n).fill(PALETTE.length);
  const good = sorted.filter((row) => data.status[row] === 0);
  good.forEach((row, place) => {
    colors[row] = Math.min(Math.floor((place / good.length) * PALETTE.length), PALETTE.length - 1);
  });
  return colors;
}

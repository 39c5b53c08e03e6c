// What the page holds: columns of numbers, and what was replayed.

/** An array of which the first axis counts rows; the others are one flat index. */
class Packed {
  constructor(floats, { first, shape }) {
    this.n = shape[0];
    this.inner = shape.slice(1);
    this.width = this.inner.reduce((a, b) => a * b, 1);
    this.values = floats.subarray(first, first + this.n * this.width);
  }

  at(row, k = 0) {
    return this.values[k * this.n + row];
  }
}

async function readData() {
  const data = JSON.parse(document.getElementById("data").textContent);
  const text = atob(document.getElementById("arrays").textContent.trim());
  const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const floats = new Float32Array(await new Response(stream).arrayBuffer());
  const array = (where) => new Packed(floats, where);
  const arrays = (record) =>
    Object.fromEntries(Object.entries(record).map(([key, where]) => [key, array(where)]));
  data.columns.forEach((column, index) => {
    column.index = index;
    column.bound ??= Infinity;
    column.value = array(column.value).values;
    column.text = column.unit ? `${column.name} [${column.unit}]` : column.name;
    column.scale = new Scale(column);
  });
  data.status = array(data.status).values;
  data.placement = data.placement && arrays(data.placement);
  for (const replay of data.replays) {
    for (const key of ["time", "frameTime", "frame"]) replay[key] = array(replay[key]);
    replay.motions = replay.motions.map(arrays);
  }
  data.replayOf = new Map(data.replays.map((replay) => [replay.row, replay]));
  return data;
}

/** A number with four significant digits. */
function short(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) return value.toExponential(2);
  return String(Number(value.toPrecision(4)));
}

/** A column's value of a row as text. */
function shown(column, row) {
  const value = column.value[row];
  if (!Number.isFinite(value)) return "–";
  if (column.labels.length) return column.labels[value];
  return value >= column.bound ? `> ${short(column.bound)}` : short(value);
}

/** From values of a column to the range 0 to 1, and back. */
class Scale {
  constructor(column) {
    this.labels = column.labels;
    this.isLog = column.isLog;
    this.isWhole = column.value.every((value) => Number.isInteger(value));
    let low = Infinity;
    let high = -Infinity;
    for (const value of column.value) {
      if (!Number.isFinite(value)) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
    this.isConstant = !(low < high);
    if (!(low <= high)) [low, high] = [0, 1];
    if (low === high) [low, high] = this.isLog ? [low / 2, high * 2] : [low - 0.5, high + 0.5];
    [this.low, this.high] = [low, high].map((x) => this.inner(x));
  }

  inner(value) {
    return this.isLog ? Math.log10(value) : value;
  }

  to(value) {
    return (this.inner(value) - this.low) / (this.high - this.low);
  }

  from(share) {
    const value = this.low + share * (this.high - this.low);
    return this.isLog ? 10 ** value : value;
  }

  /** Values to write at an axis, about so many. */
  ticks(count) {
    if (this.labels.length) {
      const every = Math.ceil(this.labels.length / Math.max(count, 1));
      return this.labels.map((_, k) => k).filter((k) => k % every === 0);
    }
    if (this.isLog && this.high - this.low >= 1) return this.decades(count);
    const [low, high] = [this.from(0), this.from(1)];
    const raw = Math.max((high - low) / Math.max(count, 1), this.isWhole ? 1 : 0);
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((x) => x * power).find((x) => x >= raw);
    const ticks = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
      ticks.push(Number((k * step).toPrecision(12)));
    }
    return ticks;
  }

  decades(count) {
    const ticks = [];
    const inner = this.high - this.low < 2 ? [1, 2, 5] : [1];
    for (let k = Math.floor(this.low); k <= this.high; k++) {
      for (const part of inner) {
        const share = this.to(part * 10 ** k);
        if (share >= -1e-9 && share <= 1 + 1e-9) ticks.push(Number((part * 10 ** k).toPrecision(3)));
      }
    }
    const every = Math.ceil(ticks.length / Math.max(count, 1));
    return ticks.filter((_, k) => k % every === 0);
  }

  text(value) {
    return this.labels.length ? this.labels[value] : short(value);
  }
}

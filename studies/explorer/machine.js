// The chosen case: its numbers, its patches to scale, its response, the machine in motion.

class ChosenCase {
  constructor(state, element) {
    Object.assign(this, { state, element, shownRow: null });
    const find = (name) => element.querySelector(`[data-part=${name}]`);
    this.parts = Object.fromEntries(
      ["name", "values", "placement", "response", "motion", "hint", "moving", "caption"].map(
        (name) => [name, find(name)]
      )
    );
    this.link = find("link");
    this.link.addEventListener("change", () => this.drawResponse());
    this.play = find("play");
    this.play.addEventListener("click", () => this.toggle());
    this.slider = find("time");
    this.slider.addEventListener("input", () => {
      this.stop();
      this.drawMachine(Number(this.slider.value));
    });
    this.nearest = find("nearest");
    this.nearest.addEventListener("click", () => state.choose(Number(this.nearest.value)));
  }

  resize() {
    this.shownRow = null;
    this.onChosen();
  }

  onChosen() {
    const row = this.state.chosen;
    if (row === this.shownRow) return;
    this.stop();
    this.shownRow = row;
    this.element.hidden = row < 0;
    if (row < 0) return;
    const { data } = this.state;
    this.parts.name.textContent = `${data.noun} ${data.names[row]}`;
    this.writeValues(row);
    this.parts.placement.parentElement.hidden = !data.placement;
    if (data.placement) this.drawPlacement(row);
    this.replay = data.replayOf.get(row);
    this.parts.motion.hidden = !this.replay;
    this.writeHint(row);
    if (this.replay) {
      this.slider.max = this.replay.frameTime.n - 1;
      this.drawResponse();
      this.drawMachine(0);
    }
  }

  writeValues(row) {
    const { data } = this.state;
    const hasBaseline = data.columns.some((column) => column.baseline !== null);
    const line = (texts) => {
      const cells = document.createElement("tr");
      for (const text of hasBaseline ? texts : texts.slice(0, 2)) {
        cells.insertCell().append(...breakable(text));
      }
      return cells;
    };
    const lines = data.columns.map((column) => {
      const before = column.baseline === null ? "" : short(column.baseline);
      return line([column.text, shown(column, row), before]);
    });
    this.parts.values.replaceChildren(...lines, line(["status", data.reasons[data.status[row]], ""]));
    this.parts.values.parentElement.tHead.rows[0].cells[2].hidden = !hasBaseline;
  }

  /** Of cases that were not replayed: how to do it, and which one is most alike. */
  writeHint(row) {
    const { data } = this.state;
    const { hint } = this.parts;
    hint.hidden = Boolean(this.replay) || !(data.command.length || data.replays.length);
    if (hint.hidden) return;
    hint.querySelector("code").textContent = data.command.join(data.names[row]);
    hint.querySelector("span").hidden = !data.command.length;
    const near = nearestReplay(data, row);
    this.nearest.hidden = near < 0;
    this.nearest.value = near;
    this.nearest.textContent = near < 0 ? "" : `show the most similar one, ${data.noun} ${data.names[near]}`;
  }

  /** The links with their patches, all lengths to one scale. */
  drawPlacement(row) {
    const canvas = this.parts.placement;
    const { data } = this.state;
    const { length, actuator, sensor, centers, is_controlled: isControlled } = data.placement;
    const width = canvas.parentElement.clientWidth;
    const context = fit(canvas, width, 190);
    const links = [...Array(length.inner[0]).keys()];
    const longest = Math.max(...links.map((i) => length.at(row, i)));
    const scale = (width - 74) / longest;
    const count = centers.inner[1];
    context.textAlign = "left";
    for (const i of links) {
      const y = 34 + 50 * i;
      context.fillStyle = INK;
      context.fillText(`link ${i + 1}`, 2, y + 4);
      context.fillStyle = isControlled.at(row, i) ? data.colors.on : data.colors.off;
      context.fillRect(50, y - 3, length.at(row, i) * scale, 6);
      for (let p = 0; p < count; p++) {
        const center = centers.at(row, i * count + p);
        if (!Number.isFinite(center)) continue;
        for (const [size, color, top] of [
          [actuator.at(row, i), data.colors.actuator, y - 10],
          [sensor.at(row, i), data.colors.sensor, y + 4],
        ]) {
          context.fillStyle = color;
          context.fillRect(50 + (center - size / 2) * scale, top, size * scale, 6);
        }
        context.fillStyle = INK;
        context.textAlign = "center";
        context.fillText(short(center), 50 + center * scale, y + 23);
        context.textAlign = "left";
      }
    }
    context.textAlign = "right";
    context.fillText("centres from the actuated joint [mm]", width - 2, 184);
  }

  drawResponse() {
    if (!this.replay) return;
    const { time, motions } = this.replay;
    const i = Number(this.link.value);
    const canvas = this.parts.response;
    const width = canvas.parentElement.clientWidth;
    const context = fit(canvas, width, 250);
    const box = { left: 58, top: 24, width: width - 68, height: 168 };
    const curves = motions.map(({ deflection }) =>
      Array.from({ length: time.n }, (_, k) => deflection.at(k, i))
    );
    const column = (value) => ({ value, labels: [], isLog: false });
    const across = new Scale(column(time.values));
    const up = new Scale(column(curves.flat()));
    drawAxes(context, box, across, up, ["time from the end of the motion [ms]", "deflection [µm]"]);
    const { controlled, without } = this.state.data.colors;
    const colors = motions.length > 1 ? [controlled, without] : [without];
    for (let k = curves.length - 1; k >= 0; k--) {
      context.strokeStyle = colors[k];
      context.lineWidth = k === 0 ? 1 : 1.8;
      context.beginPath();
      curves[k].forEach((value, j) => {
        context.lineTo(
          box.left + across.to(time.at(j)) * box.width,
          box.top + (1 - up.to(value)) * box.height
        );
      });
      context.stroke();
    }
    context.textAlign = "right";
    const names = motions.length > 1 ? ["with control", "without control"] : ["no link controlled"];
    names.forEach((name, k) => {
      context.fillStyle = colors[k];
      context.fillText(`━ ${name}`, width - 10 - 120 * (names.length - 1 - k), 14);
    });
  }

  /** The machine at an instant; where it is without control, pale. */
  drawMachine(frame) {
    const { replay } = this;
    const canvas = this.parts.moving;
    const width = canvas.parentElement.clientWidth;
    const height = Math.min(width, 380);
    const context = fit(canvas, width, height);
    const to = framed(replay.frame, width, height);
    drawCarriers(context, replay.motions[0].carrier, frame, to);
    const { controlled, without } = this.state.data.colors;
    const both = replay.motions.length > 1;
    if (both) drawParts(context, replay.motions[1], frame, to, without, 0.7);
    drawParts(context, replay.motions[0], frame, to, both ? controlled : without, 1);
    this.slider.value = frame;
    const time = replay.frameTime.at(frame);
    this.parts.caption.textContent =
      `${short(Number(time.toFixed(1)))} ms from the end of the motion; ` +
      (replay.exaggeration ? `bending drawn ${short(replay.exaggeration)} times` : "no bending") +
      (both ? "; with control dark, without pale" : "");
  }

  toggle() {
    if (this.timer) return this.stop();
    this.play.textContent = "pause";
    this.timer = setInterval(() => {
      this.drawMachine((Number(this.slider.value) + 1) % this.replay.frameTime.n);
    }, 60);
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.play.textContent = "play";
  }
}

/** Guides or cranks. */
function drawCarriers(context, carrier, frame, to) {
  context.lineWidth = 3;
  context.strokeStyle = "#bbb";
  for (let i = 0; i < carrier.inner[0]; i++) {
    const [a, b] = [4 * i, 4 * i + 2].map((k) => to(carrier.at(frame, k), carrier.at(frame, k + 1)));
    tick(context, ...a, ...b);
  }
}

/** Links, their joints and the platform of a motion. */
function drawParts(context, { near, joint, link }, frame, to, color, alpha) {
  context.globalAlpha = alpha;
  context.strokeStyle = color;
  context.fillStyle = color;
  context.lineWidth = 2;
  const [links, points] = link.inner;
  for (let i = 0; i < links; i++) {
    context.beginPath();
    for (let p = 0; p < points; p++) {
      const k = 2 * (i * points + p);
      context.lineTo(...to(link.at(frame, k), link.at(frame, k + 1)));
    }
    context.stroke();
    const [x, y] = to(near.at(frame, 2 * i), near.at(frame, 2 * i + 1));
    context.fillRect(x - 4, y - 4, 8, 8);
  }
  context.beginPath();
  for (let i = 0; i < links; i++) context.lineTo(...to(joint.at(frame, 2 * i), joint.at(frame, 2 * i + 1)));
  context.closePath();
  context.globalAlpha = 0.25 * alpha;
  context.fill();
  context.globalAlpha = 1;
}

/** From millimetres to pixels, so that the machine fills the canvas. */
function framed(frame, width, height) {
  const [left, right, low, high] = frame.values;
  const scale = 0.9 * Math.min(width / (right - left), height / (high - low));
  return (x, y) => [
    width / 2 + (x - (left + right) / 2) * scale,
    height / 2 - (y - (low + high) / 2) * scale,
  ];
}

/** The replayed row whose parameters are nearest, each over its range; -1 without any. */
function nearestReplay(data, row) {
  const columns = data.columns.filter((column) => column.isParameter);
  const away = ({ row: other }) =>
    columns.reduce((sum, { value, scale }) => {
      const gap = scale.to(value[row]) - scale.to(value[other]);
      return sum + (Number.isFinite(gap) ? gap ** 2 : 0);
    }, 0);
  let [nearest, least] = [-1, Infinity];
  for (const replay of data.replays) {
    const distance = away(replay);
    if (distance < least) [nearest, least] = [replay.row, distance];
  }
  return nearest;
}

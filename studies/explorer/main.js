// Put the page together.

/** Columns drawn at first: what varies, and the figures that matter, at most so many. */
const AT_FIRST = 8;

async function main() {
  const data = await readData();
  const state = new State(data);
  const rank = data.columns[data.rank];
  const varying = data.columns.filter((x) => x.isParameter && !x.scale.isConstant);
  const figures = data.columns.filter((x) => !x.isParameter && x !== rank);
  const others = figures.slice(0, Math.max(2, AT_FIRST - 1 - varying.length));
  const first = [...varying.slice(0, AT_FIRST - 3), rank, ...others].slice(0, AT_FIRST);

  const parallel = new ParallelPlot(state, document.querySelector("#parallel canvas"), first);
  const table = new CaseTable(state, document.getElementById("cases"), figuresFirst(first, rank));
  chooseColumns(data.columns, first, (columns) => {
    parallel.show(columns);
    table.show(figuresFirst(columns, rank));
  });
  const better = figures.find((x) => x.better) ?? figures[0] ?? rank;
  const panels = [...document.querySelectorAll(".scatter")];
  const [one, two] = [varying[0] ?? rank, varying[1] ?? figures[1] ?? rank];
  const pairs = [[better, rank], [one, varying.length > 1 ? two : rank]];
  const scatters = panels.map((panel, k) => new ScatterPlot(state, panel, ...pairs[k]));
  const conditions = new Conditions(state, document.getElementById("conditions"));
  const chosen = new ChosenCase(state, document.getElementById("chosen"));
  state.views = [conditions, parallel, ...scatters, table, chosen];
  const resize = () => [parallel, ...scatters, chosen].forEach((view) => view.resize());
  resize();
  let width = window.innerWidth;
  window.addEventListener("resize", () => {
    if (window.innerWidth !== width) resize();
    width = window.innerWidth;
  });
  requestAnimationFrame(() => (document.body.dataset.isReady = ""));
}

/** Columns as a table has them: what ranks, the other figures, what was given. */
function figuresFirst(columns, rank) {
  const place = (column) => (column === rank ? 0 : column.isParameter ? 2 : 1);
  return [...columns].sort((a, b) => place(a) - place(b));
}

/** Boxes to tick, one per column. */
function chooseColumns(columns, first, onChange) {
  const list = document.querySelector("#columns div");
  for (const column of columns) {
    const label = document.createElement("label");
    const box = document.createElement("input");
    box.type = "checkbox";
    box.value = column.index;
    box.checked = first.includes(column);
    label.append(box, ` ${column.text}`);
    list.append(label);
  }
  list.addEventListener("change", () => {
    const ticked = [...list.querySelectorAll("input:checked")].map((x) => columns[x.value]);
    if (ticked.length) onChange(ticked);
  });
}

main();

// Conditions in numbers, and the table of the brushed cases.

/** Rows of the table on one page. */
const PER_PAGE = 25;

/** A list of what is brushed, with numbers to type. */
class Conditions {
  constructor(state, element) {
    Object.assign(this, { state, element });
    this.list = element.querySelector("ul");
    this.add = element.querySelector("select");
    this.add.add(new Option("add a condition …", ""));
    for (const column of state.data.columns) this.add.add(new Option(column.text, column.index));
    this.add.addEventListener("change", () => {
      const column = state.data.columns[this.add.value];
      this.add.value = "";
      document.activeElement.blur();
      this.isAdding = true;
      state.brush(column, [-Infinity, Infinity]);
    });
    this.failures = element.querySelector("input[name=failures]");
    this.failures.addEventListener("change", () => {
      state.hasFailures = this.failures.checked;
      state.changed();
    });
    element.querySelector("button[name=clear]").addEventListener("click", () => state.clear());
    this.count = document.getElementById("count");
    this.onBrushed();
  }

  onBrushed() {
    const { state } = this;
    this.failures.checked = state.hasFailures;
    if (!this.list.contains(document.activeElement)) this.write();
    const ok = state.keptRows.filter((row) => !state.isFailed(row)).length;
    const failed = state.keptRows.length - ok;
    const isPartial = state.keptRows.some((row) => state.data.status[row] < 0);
    const how = isPartial ? "failed or have not run" : "failed";
    const text = failed ? `, ${failed.toLocaleString("en")} of them ${how}` : "";
    this.count.textContent =
      `${state.keptRows.length.toLocaleString("en")} of ${state.data.n.toLocaleString("en")} ` +
      `${state.data.noun}s selected${text}`;
  }

  write() {
    this.list.replaceChildren();
    for (const [index, range] of this.state.ranges) this.list.append(this.item(index, range));
    if (this.isAdding) this.list.lastElementChild?.querySelector("input").focus();
    this.isAdding = false;
  }

  item(index, range) {
    const { state } = this;
    const column = state.data.columns[index];
    const item = document.createElement("li");
    const [low, high] = range.map((value, k) => {
      const input = document.createElement("input");
      input.inputMode = "decimal";
      input.size = 8;
      input.value = Number.isFinite(value) ? short(value) : "";
      input.placeholder = ["lowest", "highest"][k];
      input.setAttribute("aria-label", `${input.placeholder} ${column.name}`);
      input.addEventListener("input", () => {
        const numbers = [low, high].map((x, j) => bound(x.value, j));
        state.brush(column, numbers);
      });
      return input;
    });
    const drop = document.createElement("button");
    drop.textContent = "×";
    drop.setAttribute("aria-label", `drop the condition on ${column.name}`);
    drop.addEventListener("click", () => {
      drop.blur();
      state.brush(column, null);
    });
    item.append(low, " ≤ ", named(column.text), " ≤ ", high, drop);
    return item;
  }
}

function named(text) {
  const span = document.createElement("span");
  span.textContent = text;
  return span;
}

/** A text with places where a long name in it may go on in the next line. */
function breakable(text) {
  const pieces = text.split(/(?<=[._])(?=[A-Za-z])|(?<=\w)(?=\[)/);
  return pieces.flatMap((piece, k) => (k ? [document.createElement("wbr"), piece] : [piece]));
}

/** A typed end of a range; empty or unfinished: none. */
function bound(text, k) {
  const value = text.trim() === "" ? NaN : Number(text.replace(",", "."));
  return Number.isNaN(value) ? [-Infinity, Infinity][k] : value;
}

class CaseTable {
  constructor(state, element, columns) {
    Object.assign(this, { state, columns, page: 0, isForward: true });
    this.by = state.data.columns[state.data.rank];
    this.head = element.querySelector("thead");
    this.body = element.querySelector("tbody");
    this.pages = element.querySelector("nav");
    this.show(columns);
  }

  show(columns) {
    this.columns = columns;
    const row = document.createElement("tr");
    row.append(this.heading(this.state.data.noun, null));
    for (const column of columns) row.append(this.heading(column.text, column));
    row.append(this.heading("status", null));
    this.head.replaceChildren(row);
    this.onBrushed();
  }

  heading(text, column) {
    const cell = document.createElement("th");
    if (!column) {
      cell.textContent = text;
      return cell;
    }
    const button = document.createElement("button");
    const arrow = column === this.by ? (this.isForward ? " ↓" : " ↑") : "";
    button.append(...breakable(text + arrow));
    button.title = "sort by this column";
    button.addEventListener("click", () => {
      this.isForward = column === this.by ? !this.isForward : true;
      this.by = column;
      this.show(this.columns);
    });
    cell.append(button);
    return cell;
  }

  onBrushed() {
    const { state } = this;
    const isRanked = this.by.index === state.data.rank && this.isForward;
    this.rows = isRanked
      ? state.keptRows
      : sortedBy(state.data, this.by, this.isForward).filter((row) => state.kept[row]);
    this.page = 0;
    this.write();
  }

  write() {
    const first = this.page * PER_PAGE;
    this.body.replaceChildren(
      ...this.rows.slice(first, first + PER_PAGE).map((row) => this.line(row))
    );
    const last = Math.min(first + PER_PAGE, this.rows.length);
    const turn = (text, by, isOff) => {
      const button = document.createElement("button");
      button.textContent = text;
      button.disabled = isOff;
      button.addEventListener("click", () => {
        this.page += by;
        this.write();
      });
      return button;
    };
    const range = this.rows.length ? ` ${first + 1} to ${last} of ${this.rows.length} ` : " none ";
    this.pages.replaceChildren(
      turn("‹ better", -1, first === 0),
      range,
      turn("worse ›", 1, last >= this.rows.length)
    );
    this.onChosen();
  }

  line(row) {
    const { state } = this;
    const line = document.createElement("tr");
    line.dataset.row = row;
    line.tabIndex = 0;
    const marks = state.data.replayOf.has(row) ? " ▶" : "";
    const cells = [state.data.names[row] + marks, ...this.columns.map((x) => shown(x, row))];
    for (const text of [...cells, state.data.reasons[state.data.status[row]]]) {
      line.insertCell().textContent = text;
    }
    if (state.isFailed(row)) line.classList.add("failed");
    line.addEventListener("click", () => state.choose(row));
    line.addEventListener("keydown", (event) => {
      if (event.key === "Enter") state.choose(row);
    });
    return line;
  }

  onChosen() {
    for (const line of this.body.rows) {
      line.classList.toggle("chosen", Number(line.dataset.row) === this.state.chosen);
    }
  }
}

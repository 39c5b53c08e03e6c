// A click on a heading sorts its table, once more the other way round; numbers as numbers.
for (const head of document.querySelectorAll("thead th")) {
  head.addEventListener("click", () => {
    const body = head.closest("table").tBodies[0], column = head.cellIndex;
    const isRising = head.getAttribute("aria-sort") !== "ascending";
    const text = (row) => row.cells[column].textContent.trim();
    const number = (row) => parseFloat(text(row).replace(/^[<>] ?|,/g, ""));
    const sign = isRising ? 1 : -1;
    const rows = [...body.rows].sort((a, b) => {
      const [x, y] = [number(a), number(b)];
      if (Number.isNaN(x) && Number.isNaN(y)) return sign * text(a).localeCompare(text(b));
      return Number.isNaN(x) - Number.isNaN(y) || sign * (x - y); // words last
    });
    for (const other of head.parentNode.cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", isRising ? "ascending" : "descending");
    body.append(...rows);
  });
}

"use strict";
(() => {
  const config = {
    responsive: true, displaylogo: false, showTips: false, displayModeBar: "hover",
    // these alone: plotly's own choice has a button that sends the data to a server
    modeBarButtons: [["toImage"], ["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]],
    toImageButtonOptions: { format: "svg" },
  };
  // Words at the right of the bars would leave a narrow plot no room: there they stand below the bars.
  const notesBelow = (plot, { data, layout }) => {
    const notes = (layout.annotations ?? []).filter((note) => note.xref === "paper" && note.x === 1);
    if (!notes.length) return;
    layout.margin.r = 12;
    layout.height += 20 * notes.length;
    plot.style.height = `${layout.height}px`;
    layout.yaxis.range = [notes.length - 0.3, -0.5];
    for (const bar of data) if (bar.orientation === "h") bar.width = 0.4;
    for (const note of notes) Object.assign(note, { x: 0, xshift: 0, y: note.y + 0.2, yanchor: "top" });
  };
  const plots = [...document.querySelectorAll(".plot")];
  const draw = (plot) => {
    if (plot.dataset.drawn) return;
    plot.dataset.drawn = "yes";
    const spec = JSON.parse(plot.nextElementSibling.textContent);
    if (plot.clientWidth < 600) notesBelow(plot, spec);
    Plotly.newPlot(plot, spec.data, spec.layout, config);
  };

  // A plot is drawn when it is about to be seen; meanwhile the others, one after the other; all before a print.
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) { watch.unobserve(entry.target); draw(entry.target); }
  }, { rootMargin: "600px" });
  plots.forEach((plot) => watch.observe(plot));
  const next = (at) => { if (at < plots.length) { draw(plots[at]); setTimeout(next, 20, at + 1); } };
  setTimeout(next, 100, 0);
  const width = (of) => plots.forEach((plot) => Plotly.relayout(plot, of(plot)));
  addEventListener("beforeprint", () => {
    plots.forEach(draw);
    document.querySelectorAll("details").forEach((each) => { each.dataset.was = each.open ? "open" : ""; each.open = true; });
    width((plot) => ({ autosize: false, width: plot.closest(".wide") ? 1000 : 485 }));
  });
  addEventListener("afterprint", () => {
    document.querySelectorAll("details").forEach((each) => { each.open = each.dataset.was === "open"; });
    width(() => ({ autosize: true, width: null }));
  });

  // Tables: a click or Enter on a head sorts, numbers by their full value; what has none comes last.
  const key = (cell) => {
    const value = cell.dataset.v ?? cell.textContent;
    const number = Number(value);
    return value.trim() === "" || value === "–" ? null : Number.isNaN(number) ? value.toLowerCase() : number;
  };
  const compare = (one, other) => {
    if (one === null || other === null) return (one === null) - (other === null);
    if (typeof one === typeof other) return one < other ? -1 : one > other ? 1 : 0;
    return typeof one === "number" ? -1 : 1;
  };
  document.querySelectorAll("button.sort").forEach((button) => button.addEventListener("click", () => {
    const head = button.closest("th"), body = head.closest("table").tBodies[0], column = head.cellIndex;
    const before = head.getAttribute("aria-sort");
    const down = before ? before === "ascending" : !head.classList.contains("words");
    head.parentElement.querySelectorAll("th").forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const rows = [...body.rows].map((row) => [key(row.cells[column]), row]);
    rows.sort(([one], [other]) => (one === null || other === null ? 1 : down ? -1 : 1) * compare(one, other));
    body.append(...rows.map(([, row]) => row));
  }));
  document.querySelectorAll(".filter input").forEach((input) => input.addEventListener("input", () => {
    const rows = [...document.getElementById(input.dataset.table).querySelectorAll("tbody tr")];
    const wanted = input.value.trim().toLowerCase();
    rows.forEach((row) => { row.hidden = !row.textContent.toLowerCase().includes(wanted); });
    input.parentElement.querySelector("output").textContent =
      wanted ? `${rows.filter((row) => !row.hidden).length} of ${rows.length} rows` : "";
  }));
})();

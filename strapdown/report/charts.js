"use strict";
// Interactive time series: drag to zoom, double click to see all, hover to read. Charts of one page share their cursor.
(function () {
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const cursors = uPlot.sync("time");
  const drawn = [];
  function draw(holder) {
    const chart = JSON.parse(holder.querySelector("script").textContent);
    const place = holder.querySelector(".plot");
    place.textContent = "";
    const axis = { stroke: colour("--ink"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line") } };
    const shown = (u, value) => (value == null ? "–" : Number(value).toPrecision(5));
    const plot = new uPlot(
      {
        width: Math.max(240, place.clientWidth),
        height: 260,
        cursor: { sync: { key: cursors.key }, drag: { x: true, y: false } },
        scales: { x: { time: false }, y: chart.range ? { range: (u, low, high) => (u.zoomed ? [low, high] : chart.range) } : {} },
        axes: [{ ...axis, label: "time, s" }, { ...axis, label: chart.unit, size: 70 }],
        series: [
          { label: "time, s", value: shown },
          ...chart.series.map((one) => ({
            label: one.label,
            stroke: colour(one.colour),
            width: one.band ? 0 : 1.5, // the edges of a band would alias into a grey bar over the errors
            points: { show: one.band ? false : undefined },
            value: shown,
          })),
        ],
        bands: chart.bands.map((pair) => ({ series: pair, fill: colour("--band") })),
        hooks: { setSelect: [(u) => { u.zoomed = true; }] },
      },
      chart.data,
      place
    );
    plot.over.addEventListener("dblclick", () => { plot.zoomed = false; });
    drawn.push({ plot, place });
  }
  function all() {
    drawn.splice(0).forEach((one) => one.plot.destroy());
    document.querySelectorAll(".chart").forEach(draw);
  }
  all();
  let waiting = 0;
  window.addEventListener("resize", () => {
    clearTimeout(waiting);
    waiting = setTimeout(() => {
      drawn.forEach((one) => one.plot.setSize({ width: Math.max(240, one.place.clientWidth), height: 260 }));
    }, 100);
  });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", all);
})();

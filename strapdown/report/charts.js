"use strict";
// Interactive charts: drag to zoom, double click to see all, hover to read, keys as in HELP. Charts over time share cursor and zoom.
(function () {
  const TIME = "time, s"; // the axis along which the body turns
  const HELP = "Keys: plus and minus zoom, left and right arrow move, 0 shows all.";
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const MISSING = -32768;
  const BLOCK = 4096;
  let drawn = [];

  // ------------------------------------------------------------------------------------------------------------------- data

  async function inflated(base64, bytes) {
    const packed = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const planes = new Uint8Array(await new Response(stream).arrayBuffer());
    const n = planes.length / bytes;
    const values = new Array(n);
    for (let i = 0; i < n; i++) {
      let value = 0;
      for (let b = bytes - 1; b >= 0; b--) value = value * 256 + planes[b * n + i];
      values[i] = value >= 2 ** (8 * bytes - 1) ? value - 2 ** (8 * bytes) : value;
    }
    return values; // differences
  }

  async function numbers(column) {
    const values = await inflated(column.deflate, 2);
    let sum = 0;
    return values.map((difference, i) => {
      sum = (((sum + difference + 32768) % 65536) + 65536) % 65536 - 32768;
      const block = Math.floor(i / BLOCK);
      return sum === MISSING ? null : column.offset[block] + column.scale[block] * sum;
    });
  }

  async function times(column) {
    let sum = 0;
    return (await inflated(column.deflate, 4)).map((difference) => column.first + column.tick * (sum += difference));
  }

  async function loaded(holder) {
    const content = JSON.parse(holder.querySelector("script").textContent);
    content.columns = await Promise.all([times(content.time), ...content.data.map(numbers)]);
    return { holder, content };
  }

  // ------------------------------------------------------------------------------------------------------------------ charts

  function draw({ holder, content }) {
    const place = holder.querySelector(".plot");
    place.textContent = "";
    const named = content.ticks.length > 0;
    const axis = { stroke: colour("--ink"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line") } };
    const shown = (u, value) => (value == null ? "–" : Number(value).toPrecision(5));
    const letters = Math.max(...content.ticks.map((name) => name.length));
    const steep = (u) => content.ticks.length * (7 * letters + 10) > u.width - 90; // names would run into each other
    const names = named
      ? { splits: () => content.ticks.map((_, k) => k), values: () => content.ticks, rotate: (u) => (steep(u) ? 30 : 0), size: (u) => (steep(u) ? 70 : 36) }
      : {};
    const decades = (u, splits) => splits.map((value) => (Math.abs(Math.log10(value) - Math.round(Math.log10(value))) < 1e-9 ? value : null));
    const written = (u, splits) => splits.map((value) => (value == null ? "" : String(Number(value.toPrecision(6))))); // uPlot rounds to 0.001
    const scale = (log) => ({
      ...axis,
      values: written,
      ...(log ? { grid: { ...axis.grid, filter: decades }, ticks: { ...axis.ticks, filter: decades } } : {}), // those between decades would be a grey area
    });
    const vertical = content.range
      ? { range: (u, low, high) => (u.zoomed ? [low, high] : content.range) }
      : content.log ? { distr: 3 } : {};
    const edges = content.series.flatMap((one, k) => (one.band ? [k + 1] : [])); // upper, lower, upper, lower, …
    const bands = edges.flatMap((upper, k) => (k % 2 ? [] : [{ series: [upper, edges[k + 1]], fill: colour("--band") }]));
    const plot = new uPlot(
      {
        width: Math.max(240, place.clientWidth),
        height: 260,
        legend: { markers: { // as the lines are drawn
          dash: (u, k) => (content.series[k - 1].dash ? "dashed" : "solid"),
          fill: (u, k) => (content.series[k - 1].band ? colour("--band") : "transparent"),
        } },
        cursor: { sync: named ? undefined : { key: content.x }, drag: { x: true, y: false } },
        scales: { x: { time: false, distr: content.log_x ? 3 : 1, range: named ? [-0.5, content.ticks.length - 0.5] : undefined }, y: vertical },
        axes: [
          { ...scale(content.log_x), label: named ? undefined : content.x, ...names },
          { ...scale(content.log), label: content.unit, size: 70 },
        ],
        series: [
          { label: content.x, value: named ? (u, value) => content.ticks[value] ?? "–" : shown },
          ...content.series.map((one, k) => ({
            label: one.label,
            stroke: colour(one.colour),
            width: one.band || named ? 0 : 1.5, // the edges of a band would alias into a grey bar over the errors
            dash: one.dash ? [6, 4] : undefined,
            points: { show: one.band ? false : named ? true : undefined, size: named ? Math.max(5, 12 - 3 * k) : undefined, fill: named ? colour(one.colour) : undefined },
            value: shown,
          })),
        ],
        bands,
        hooks: { setSelect: [(u) => { u.zoomed = true; }], setCursor: [(u) => { if (content.x === TIME) turn(u.posToVal(u.cursor.left, "x"), u.cursor.left); }] },
      },
      content.columns,
      place
    );
    plot.whole = [content.columns[0][0], content.columns[0][content.columns[0].length - 1]];
    plot.named = named;
    plot.key = content.x; // charts of one axis are zoomed together
    // In the capture phase, before uPlot shows all of this chart alone.
    plot.over.addEventListener("dblclick", (event) => { event.stopImmediatePropagation(); reset(); }, true);
    place.setAttribute("role", "group");
    place.setAttribute("aria-label", `${content.title}. ${HELP}`);
    place.onkeydown = (event) => key(event, plot);
    const canvas = place.querySelector("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${content.title}: ${content.unit} over ${named ? content.ticks.join(", ") : content.x}`);
    place.querySelectorAll(".u-legend .u-series:not(:first-child) th").forEach((head) => legend(head));
    drawn.push({ plot, place });
  }

  function legend(head) { // a button for the keyboard: shows and hides its line
    const row = head.closest(".u-series");
    head.tabIndex = 0;
    head.setAttribute("role", "button");
    const mark = () => head.setAttribute("aria-pressed", String(!row.classList.contains("u-off")));
    mark();
    head.addEventListener("click", () => setTimeout(mark));
    head.addEventListener("keydown", (event) => {
      if (event.key === "Enter" || event.key === " ") {
        event.preventDefault();
        event.stopPropagation();
        head.click();
      }
    });
  }

  const others = (plot) => (plot.named ? [plot] : drawn.map((one) => one.plot).filter((one) => one.key === plot.key));

  function show(plot, low, high) {
    others(plot).forEach((one) => {
      one.zoomed = true;
      one.setScale("x", { min: Math.max(low, one.whole[0]), max: Math.min(high, one.whole[1]) });
    });
  }

  function reset() {
    drawn.filter((one) => !one.plot.named).forEach(({ plot }) => {
      plot.zoomed = false;
      plot.setScale("x", { min: plot.whole[0], max: plot.whole[1] });
    });
  }

  function key(event, plot) {
    const { min, max } = plot.scales.x;
    const width = max - min;
    const middle = plot.cursor.left >= 0 ? plot.posToVal(plot.cursor.left, "x") : 0.5 * (min + max);
    const moves = {
      "+": () => show(plot, middle - 0.5 * (middle - min), middle + 0.5 * (max - middle)),
      "-": () => show(plot, middle - 2 * (middle - min), middle + 2 * (max - middle)),
      ArrowLeft: () => show(plot, Math.max(min - 0.25 * width, plot.whole[0]), Math.max(max - 0.25 * width, plot.whole[0] + width)),
      ArrowRight: () => show(plot, Math.min(min + 0.25 * width, plot.whole[1] - width), Math.min(max + 0.25 * width, plot.whole[1])),
      0: reset,
      Escape: reset,
    };
    const move = moves[event.key === "=" ? "+" : event.key];
    if (move && !plot.named && !event.ctrlKey && !event.metaKey) {
      event.preventDefault();
      move();
    }
  }

  // -------------------------------------------------------------------------------------------------------- body at the cursor

  let bodies = [];
  const EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

  function rotated([w, x, y, z], [a, b, c]) { // q ⊗ v ⊗ q⁻¹
    const t = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
    return [a + w * t[0] + y * t[2] - z * t[1], b + w * t[1] + z * t[0] - x * t[2], c + w * t[2] + x * t[1] - y * t[0]];
  }

  function picture({ holder, content }, k) {
    const canvas = holder.querySelector("canvas");
    const pen = canvas.getContext("2d");
    const size = canvas.width;
    const q = content.columns.slice(1).map((column) => column[k]);
    const at = ([x, y, z]) => [size / 2 + (0.92 * x - 0.24 * y) * size * 0.37, size * 0.54 - (0.3 * x + 0.42 * y + 0.9 * z) * size * 0.37];
    const line = (from, to, stroke, width, name) => {
      pen.strokeStyle = pen.fillStyle = stroke;
      pen.lineWidth = width;
      pen.beginPath();
      pen.moveTo(...at(from));
      pen.lineTo(...at(to));
      pen.stroke();
      if (name) pen.fillText(name, ...at(to.map((value) => 1.12 * value)));
    };
    pen.clearRect(0, 0, size, size);
    pen.font = `${size / 18}px system-ui, sans-serif`;
    pen.textAlign = "center";
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]].forEach((axis, i) => line([0, 0, 0], axis, colour("--line"), 2, "xyz"[i]));
    const corners = [...Array(8).keys()].map((i) => rotated(q, [i & 4 ? 0.5 : -0.5, i & 2 ? 0.3 : -0.3, i & 1 ? 0.08 : -0.08]));
    EDGES.forEach(([i, j]) => line(corners[i], corners[j], colour("--faint"), 2));
    ["--a", "--b", "--c"].forEach((name, i) => line([0, 0, 0], rotated(q, [0, 1, 2].map((j) => (i === j ? 0.85 : 0))), colour(name), 4, "xyz"[i]));
    holder.querySelector("p").textContent = `${content.columns[0][k].toPrecision(6)} s: body axes x, y, z in the fixed frame (grey)`;
  }

  function turn(time, left) {
    bodies.forEach((one) => {
      const column = one.content.columns[0];
      const k = left >= 0 ? Math.min(column.length - 1, Math.max(0, nearest(column, time))) : column.length - 1;
      if (k !== one.k) picture(one, (one.k = k));
    });
  }

  function nearest(column, time) {
    let low = 0;
    let high = column.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (column[middle] <= time) low = middle; else high = middle;
    }
    return time - column[low] < column[high] - time ? low : high;
  }

  // --------------------------------------------------------------------------------------------------------------------- page

  let charts = [];
  function all() {
    const zooms = drawn.filter((one) => one.plot.zoomed && !one.plot.named).map(({ plot }) => [plot.key, plot.scales.x.min, plot.scales.x.max]);
    drawn.splice(0).forEach((one) => one.plot.destroy());
    charts.forEach(draw);
    bodies.forEach((one) => picture(one, (one.k ??= one.content.columns[0].length - 1)));
    zooms.forEach(([key, low, high]) => show(drawn.find((one) => one.plot.key === key).plot, low, high));
  }
  async function begin() {
    if (typeof DecompressionStream === "undefined") {
      document.querySelectorAll(".plot").forEach((place) => { place.textContent = "This browser is too old to show the charts (it lacks DecompressionStream)."; });
      return;
    }
    [charts, bodies] = await Promise.all([".chart", ".body"].map((kind) => Promise.all([...document.querySelectorAll(kind)].map(loaded))));
    all();
    document.documentElement.dataset.drawn = String(drawn.length);
  }
  begin();
  let waiting = 0;
  window.addEventListener("resize", () => {
    clearTimeout(waiting);
    waiting = setTimeout(() => {
      drawn.forEach((one) => one.plot.setSize({ width: Math.max(240, one.place.clientWidth), height: 260 }));
    }, 100);
  });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", all);
  ["beforeprint", "afterprint"].forEach((when) => window.addEventListener(when, () => {
    document.documentElement.classList.toggle("print", when === "beforeprint"); // light colours on paper
    all();
  }));
  window.strapdownCharts = { drawn: () => drawn, reset, bodies: () => bodies };
})();

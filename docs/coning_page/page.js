// The controls and drawings of the page on coning. Everything is computed anew, with the exported filter, at each move of a slider.

const DEGREE = Math.PI / 180;
const DEGREE_PER_HOUR = DEGREE / 3600;
const ARCSECOND = DEGREE / 3600;

/** Controls: label, values from least to greatest or list of values, first value, text of a value. */
const CONTROLS = {
  angle: { label: "cone half-angle β", range: [0.1, 4.9], value: 0.7, text: (x) => `${x.toPrecision(2)}°` },
  frequency: { label: "rate of the cone", range: [5, 20], value: 10, text: (x) => `${x.toPrecision(2)} Hz` },
  sampleRate: { label: "samples", values: [50, 100, 200, 400], value: 100, text: (x) => `${x} Hz` },
  noise: { label: "gyro noise", range: [0.2, 5], value: 1, text: (x) => `${(x * SETUP.angleRandomWalk / DEGREE * 60).toPrecision(2)} °/√h` },
};

function control(name, { label, range, values, value, text }, changed) {
  const row = document.createElement("label");
  const input = document.createElement("input");
  const shown = document.createElement("output");
  input.type = "range";
  input.name = name;
  const last = values ? values.length - 1 : 200;
  Object.assign(input, { min: 0, max: last, step: 1 });
  const at = (x) => (values ? values[x] : range[0] * (range[1] / range[0]) ** (x / last)); // a slider of equal ratios
  input.value = values ? values.indexOf(value) : Math.round((last * Math.log(value / range[0])) / Math.log(range[1] / range[0]));
  const update = () => {
    shown.textContent = text(at(Number(input.value)));
    input.setAttribute("aria-valuetext", shown.textContent);
  };
  input.addEventListener("input", () => { update(); changed(); });
  update();
  row.append(`${label} `, input, shown);
  return { row, value: () => at(Number(input.value)) };
}

function choice(names, first, changed) {
  const row = document.createElement("label");
  const select = document.createElement("select");
  names.forEach((name) => select.add(new Option(name, name, false, name === first)));
  select.name = "algorithm";
  select.addEventListener("change", changed);
  row.append("algorithm ", select, document.createElement("output"));
  return { row, value: () => select.value };
}

/** A canvas for drawing in CSS pixels, sharp on any screen. */
function drawing(name, height) {
  const canvas = document.createElement("canvas");
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", name);
  canvas.style.height = `${height}px`;
  return {
    canvas,
    begin() {
      const scale = window.devicePixelRatio || 1;
      const width = canvas.clientWidth;
      canvas.width = Math.round(width * scale);
      canvas.height = Math.round(height * scale);
      const pen = canvas.getContext("2d");
      pen.scale(scale, scale);
      pen.font = "12px sans-serif";
      const style = getComputedStyle(canvas);
      const ink = style.color;
      pen.strokeStyle = pen.fillStyle = ink;
      return { pen, width, height, ink };
    },
  };
}

const BLUE = "#2a78c8";
const ORANGE = "#d9731a";

/** The cone, body z around it, the moments at which the gyro is sampled, and the polygon that the one-sample algorithm follows. */
function drawCone(place, { angle, frequency, sampleRate }) {
  const { pen, width, height, ink } = place.begin();
  const opening = 32 * DEGREE; // a small cone is drawn as a wide one
  const tilt = 20 * DEGREE;
  const scale = 0.78 * height;
  const spot = (azimuth) => [
    0.5 * width + scale * Math.sin(opening) * Math.cos(azimuth),
    0.93 * height - scale * (Math.cos(opening) * Math.cos(tilt) + Math.sin(opening) * Math.sin(tilt) * Math.sin(azimuth)),
  ];
  const line = (points, color, thick) => {
    pen.beginPath();
    points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.strokeStyle = color;
    pen.lineWidth = thick;
    pen.stroke();
  };
  const apex = [0.5 * width, 0.93 * height];
  const circle = Array.from({ length: 97 }, (_, i) => spot((2 * Math.PI * i) / 96));
  line(circle, BLUE, 2);
  pen.setLineDash([5, 4]);
  line([apex, [0.5 * width, 0.93 * height - 1.08 * scale * Math.cos(tilt)]], ink, 1);
  pen.setLineDash([]);
  const turn = sampleRate / frequency; // samples a turn
  const corners = Array.from({ length: Math.min(Math.ceil(turn), 200) + 1 }, (_, i) => spot((2 * Math.PI * i) / turn));
  line(corners, ORANGE, 1.5);
  corners.forEach(([x, y]) => { pen.fillStyle = ORANGE; pen.fillRect(x - 2, y - 2, 4, 4); });
  line([apex, corners[0]], BLUE, 3);
  pen.fillStyle = ink;
  pen.fillText("axis", 0.5 * width + 6, 14);
  pen.fillStyle = BLUE;
  pen.fillText("body z", corners[0][0] + 8, corners[0][1] - 6);
  pen.fillStyle = ink;
  pen.fillText(`β = ${(angle / DEGREE).toPrecision(2)}° (drawn wider), ${turn.toPrecision(3)} samples a turn`, 4, height - 4);
}

/** The largest of 1, 2 and 5 times a power of ten that is not above x. */
function tick(x) {
  const power = 10 ** Math.floor(Math.log10(x));
  return power * (x >= 5 * power ? 5 : x >= 2 * power ? 2 : 1);
}

/** A curve within ±3σ, in a unit. */
function drawError(place, title, unit, unitName, { time, value, sigma }) {
  const { pen, width, height, ink } = place.begin();
  const [left, right, top, bottom] = [64, width - 8, 22, height - 26];
  let limit = 0;
  for (let i = 0; i < time.length; i += 1) {
    if (time[i] > 3) limit = Math.max(limit, Math.abs(value[i]), 3.2 * sigma[i]);
  }
  limit *= 1.1;
  const mark = tick(limit / unit);
  const x = (t) => left + ((right - left) * t) / time.at(-1);
  const y = (v) => 0.5 * (top + bottom) - (0.5 * (bottom - top) * Math.max(-1.1, Math.min(1.1, v / limit)));
  pen.save();
  pen.beginPath();
  pen.rect(left, top, right - left, bottom - top);
  pen.clip();
  pen.beginPath();
  const each = Math.max(1, Math.floor(time.length / (2 * (right - left))));
  for (let i = 0; i < time.length; i += each) pen.lineTo(x(time[i]), y(3 * sigma[i]));
  for (let i = time.length - 1; i >= 0; i -= each) pen.lineTo(x(time[i]), y(-3 * sigma[i]));
  pen.globalAlpha = 0.22;
  pen.fillStyle = BLUE;
  pen.fill();
  pen.globalAlpha = 1;
  pen.beginPath();
  for (let i = 0; i < time.length; i += each) pen.lineTo(x(time[i]), y(value[i]));
  pen.strokeStyle = ORANGE;
  pen.lineWidth = 1.5;
  pen.stroke();
  pen.restore();
  pen.strokeStyle = ink;
  pen.lineWidth = 0.7;
  pen.strokeRect(left, top, right - left, bottom - top);
  pen.fillStyle = ink;
  pen.fillText(`${title}: error and ±3σ, ${unitName}`, left, 14);
  pen.textAlign = "right";
  [-1, 0, 1].forEach((part) => {
    const value = part * mark;
    pen.fillText(`${value < 0 ? "−" : ""}${Number(Math.abs(value).toPrecision(1))}`, left - 8, y(value * unit) + 4);
    pen.beginPath();
    pen.moveTo(left - 5, y(value * unit));
    pen.lineTo(left, y(value * unit));
    pen.stroke();
  });
  pen.textAlign = "center";
  [0, 10, 20, 30].forEach((t) => pen.fillText(`${t} s`, Math.min(x(t), right - 12), height - 8));
  pen.textAlign = "left";
}

/** What the run says of the filter: its errors about the axis at the end in σ. */
function verdict(run) {
  const signed = (x, unit, digits = 3) => `${x < 0 ? "−" : ""}${Math.abs(x / unit).toPrecision(digits)}`;
  const [attitude, bias] = [run.error.at(-1) / run.sigma.at(-1), run.bias.at(-1) / run.biasSigma.at(-1)];
  const numbers =
    `Drift predicted for a small cone: ${signed(run.drift, DEGREE_PER_HOUR)} °/h. At the end the bias is wrong by ` +
    `${signed(run.bias.at(-1), DEGREE_PER_HOUR)} °/h (${Math.abs(bias).toFixed(1)} σ), the attitude by ` +
    `${signed(run.error.at(-1), ARCSECOND)}″ (${Math.abs(attitude).toFixed(1)} σ).`;
  const worst = Math.max(Math.abs(attitude), Math.abs(bias));
  // Two normal errors: one of them exceeds 3.3 σ in 0.2 % of runs.
  return worst > 3.3 ? ["not consistent", numbers] : ["cannot tell: nothing in this run speaks against the filter", numbers];
}

function start(root) {
  let waiting = false;
  const changed = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); });
  };
  const controls = Object.fromEntries(Object.entries(CONTROLS).map(([name, about]) => [name, control(name, about, changed)]));
  controls.algorithm = choice(Object.keys(ALGORITHMS), "one-sample", changed);
  const panel = document.createElement("form");
  panel.append(...Object.values(controls).map(({ row }) => row));
  const cone = drawing("The cone, and the samples of a turn", 240);
  const error = drawing("Attitude error about the cone's axis with three sigma", 240);
  const bias = drawing("Error of the gyro bias about z with three sigma", 240);
  const words = document.createElement("p");
  words.setAttribute("aria-live", "polite");
  const headline = document.createElement("strong");
  const numbers = document.createTextNode("");
  words.append(headline, " ", numbers);
  root.append(panel, words, cone.canvas, error.canvas, bias.canvas);
  function draw() {
    const settings = Object.fromEntries(Object.entries(controls).map(([name, { value }]) => [name, value()]));
    settings.angle *= DEGREE;
    const run = simulate(settings);
    drawCone(cone, settings);
    drawError(error, "Attitude about the axis", ARCSECOND, "″", { time: run.time, value: run.error, sigma: run.sigma });
    drawError(bias, "Gyro bias z", DEGREE_PER_HOUR, "°/h", { time: run.time, value: run.bias, sigma: run.biasSigma });
    const [word, sentence] = verdict(run);
    root.dataset.verdict = headline.textContent = word;
    numbers.data = sentence;
    root.dataset.drawn = String(Number(root.dataset.drawn || 0) + 1);
  }
  new ResizeObserver(changed).observe(root);
}

document.addEventListener("DOMContentLoaded", () => {
  const root = document.getElementById("coning-interactive");
  if (root) start(root);
});

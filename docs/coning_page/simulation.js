// A run of the exported filter on a cone: gyro increments in closed form, a coning algorithm, two star directions a second.
// Uses the filter (create, init, predict, update_star_1, update_star_2, sigma) and ALGORITHMS, k_1, k_2, ... by name.

const DURATION = 30; // s
const STAR_INTERVAL = 1; // s
const MAX_ROWS = 1000; // of the series that are returned

/** Independent standard normal numbers, the same for a seed: mulberry32 and Box-Muller. */
function normals(seed, count) {
  let state = seed >>> 0;
  const uniform = () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let word = Math.imul(state ^ (state >>> 15), state | 1);
    word ^= word + Math.imul(word ^ (word >>> 7), word | 61);
    return (((word ^ (word >>> 14)) >>> 0) + 0.5) / 4294967296;
  };
  const values = new Float64Array(count);
  for (let k = 0; k < count; k += 1) {
    values[k] = Math.sqrt(-2 * Math.log(uniform())) * Math.cos(2 * Math.PI * uniform());
  }
  return values;
}

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** The vector v_f in body axes, q* v q. */
function toBody(q, v) {
  const u = [-q[1], -q[2], -q[3]];
  const t = cross(u, v).map((x) => 2 * x);
  const s = cross(u, t);
  return v.map((x, i) => x + q[0] * t[i] + s[i]);
}

/** Attitude on the cone, equation (18). */
function attitudeOnCone(angle, rate, t) {
  const s = Math.sin(0.5 * angle);
  return [Math.cos(0.5 * angle), s * Math.cos(rate * t), s * Math.sin(rate * t), 0];
}

/** Integral of the body rate (-w sin b sin wt, w sin b cos wt, w (cos b - 1)) from t to t + h. */
function incrementOnCone(angle, rate, t, h) {
  const chord = 2 * Math.sin(angle) * Math.sin(0.5 * rate * h);
  const middle = rate * (t + 0.5 * h);
  return [-chord * Math.sin(middle), chord * Math.cos(middle), -2 * rate * h * Math.sin(0.5 * angle) ** 2];
}

/** Rotation vector of a step: the sum of N increments, and (k_1 d_{N-1} + k_2 d_{N-2} + ...) x d_N. */
function stepOf(increments, k) {
  const last = increments.at(-1);
  const weighted = [0, 0, 0];
  const sum = [...last];
  for (let j = 1; j < increments.length; j += 1) {
    const d = increments[increments.length - 1 - j];
    for (let i = 0; i < 3; i += 1) {
      weighted[i] += k[j - 1] * d[i];
      sum[i] += d[i];
    }
  }
  return cross(weighted, last).map((x, i) => x + sum[i]);
}

/** Drift about the axis of a small cone, rad/s: the lag sums of the algorithm against the area of the circle. */
function predictedDrift(angle, rate, h, k) {
  const x = rate * h;
  const n = k.length + 1;
  const lags = k.reduce((sum, value, j) => sum + value * 2 * (1 - Math.cos(x)) * Math.sin((j + 1) * x), 0);
  return (angle ** 2 * (lags - 0.5 * (n * x - Math.sin(n * x)))) / (n * h);
}

/** v' P v of three of the filter's errors, from the first: 0 attitude, 3 bias. */
function quadratic(f, first, v) {
  let sum = 0;
  for (let i = 0; i < 3; i += 1) {
    for (let j = i; j < 3; j += 1) {
      const row = first + i;
      sum += (i === j ? 1 : 2) * v[i] * v[j] * f.P[(row * (11 - row)) / 2 + first + j];
    }
  }
  return sum;
}

/** Error of the attitude, a rotation vector in body axes: q_true = q exp(error). */
function errorOf(q, truth) {
  const w = q[0] * truth[0] + q[1] * truth[1] + q[2] * truth[2] + q[3] * truth[3];
  const c = cross(q.slice(1), truth.slice(1));
  const v = [1, 2, 3].map((i) => q[0] * truth[i] - truth[0] * q[i] - c[i - 1]);
  const length = Math.hypot(...v);
  const scale = length > 0 ? (2 * Math.atan2(length, Math.abs(w))) / length : 2;
  return v.map((x) => Math.sign(w || 1) * scale * x);
}

/**
 * Run the filter. angle: of the cone, rad; frequency, sampleRate: Hz; algorithm: its name; noise: of the gyro and its bias, times those
 * of the filter's setup. A gyro is noise times as noisy to a filter whose clock runs noise^2 times as fast, so one exported filter serves
 * all: its angle random walk grows by noise, and its initial bias, a rate, by noise^2. Returns series, and numbers at the end.
 */
function simulate({ angle, frequency, sampleRate, algorithm, noise, seed = 1, noiseless = false }) {
  const k = ALGORITHMS[algorithm];
  const samples = k.length + 1;
  const rate = 2 * Math.PI * frequency;
  const h = 1 / sampleRate;
  const steps = Math.floor((DURATION * sampleRate) / samples);
  const clock = noise ** 2;
  const sigma = SETUP.angleRandomWalk * noise * Math.sqrt(h); // of an increment
  const random = normals(seed, 3 * samples * steps + 6 * DURATION + 3);
  if (noiseless) random.fill(0);
  let drawn = 0;
  const bias = [0, 1, 2].map(() => SETUP.biasSigma * clock * random[drawn++]);
  const f = create();
  init(f, attitudeOnCone(angle, rate, 0));
  const series = { time: [], error: [], sigma: [], bias: [], biasSigma: [] };
  const every = Math.ceil(steps / MAX_ROWS);
  let nextStar = STAR_INTERVAL;
  for (let step = 1; step <= steps; step += 1) {
    const increments = [];
    for (let i = (step - 1) * samples; i < step * samples; i += 1) {
      const d = incrementOnCone(angle, rate, i * h, h);
      for (let axis = 0; axis < 3; axis += 1) d[axis] += bias[axis] * h + sigma * random[drawn++];
      increments.push(d);
    }
    const t = step * samples * h;
    const dt = samples * h * clock;
    predict(f, stepOf(increments, k).map((x) => x / dt), dt);
    const measured = t > nextStar - 1e-9;
    const kept = step % every === 0 || step === steps;
    if (!measured && !kept) continue;
    const truth = attitudeOnCone(angle, rate, t);
    if (measured) {
      [update_star_1, update_star_2].forEach((update, star) => {
        const reference = toBody(truth, SETUP.stars[star]);
        update(f, reference.map((x) => x + SETUP.starSigma * random[drawn++]));
      });
      nextStar += STAR_INTERVAL;
    }
    if (!kept) continue;
    const axis = toBody(truth, [0, 0, 1]);
    const error = errorOf(f.attitude, truth);
    series.time.push(t);
    series.error.push(error[0] * axis[0] + error[1] * axis[1] + error[2] * axis[2]);
    series.sigma.push(Math.sqrt(quadratic(f, 0, axis)));
    series.bias.push(bias[2] - f.bias[2] * clock);
    series.biasSigma.push(clock * Math.sqrt(quadratic(f, 3, [0, 0, 1])));
  }
  return {
    ...series,
    drift: predictedDrift(angle, rate, h, k),
    attitude: Array.from(f.attitude),
    biasEstimate: Array.from(f.bias, (x) => x * clock),
    status: f.status,
  };
}

// Colour scales, made in the perceptual space OKLCH (Ottosson 2020) so that equal steps look equal.

const SIZE = 256;

/** Linear sRGB, 0 … 1, of an OKLCH colour: lightness 0 … 1, chroma, hue in degrees. */
function linearFromOklch(lightness, chroma, hue) {
  const a = chroma * Math.cos((hue * Math.PI) / 180);
  const b = chroma * Math.sin((hue * Math.PI) / 180);
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  return [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ].map((value) => Math.min(1, Math.max(0, value)));
}

const mix = (from, to, t) => from + (to - from) * t;

/** Dark violet over blue and green to light yellow. */
const sequential = (t) => linearFromOklch(mix(0.26, 0.93, t), 0.09 + 0.24 * t * (1 - t) + 0.06 * t, mix(305, 105, t));

/** Blue over near-white to red. */
function diverging(t) {
  const side = 2 * t - 1;
  const away = Math.abs(side);
  return linearFromOklch(mix(0.96, 0.42, away), 0.19 * away ** 0.85, side < 0 ? 258 : 27);
}

function table(scale) {
  const colours = new Float32Array(3 * SIZE);
  for (let i = 0; i < SIZE; i++) colours.set(scale(i / (SIZE - 1)), 3 * i);
  return colours;
}

export const SCALES = { sequential: table(sequential), diverging: table(diverging) };
export const UNMEASURED = [0.22, 0.22, 0.22]; // linear grey

/** Write the linear colour of a value between the limits into target[at … at + 2]. */
export function paint(scale, value, low, high, target, at) {
  if (!Number.isFinite(value)) {
    target.set(UNMEASURED, at);
    return;
  }
  const share = high > low ? (value - low) / (high - low) : 0.5;
  const index = 3 * Math.round(Math.min(1, Math.max(0, share)) * (SIZE - 1));
  target[at] = scale[index];
  target[at + 1] = scale[index + 1];
  target[at + 2] = scale[index + 2];
}

const encode = (linear) => Math.round(255 * (linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055));

/** The scale as a CSS gradient from bottom to top. */
export function cssGradient(scale) {
  const stops = [];
  for (let i = 0; i <= 16; i++) {
    const index = 3 * Math.round((i / 16) * (SIZE - 1));
    stops.push(`rgb(${[0, 1, 2].map((k) => encode(scale[index + k])).join(" ")})`);
  }
  return `linear-gradient(to top, ${stops.join(", ")})`;
}

/** Round values inside the limits for the ticks of a legend, about `count` of them. */
export function ticks(low, high, count = 6) {
  const span = high - low;
  if (!(span > 0)) return [low];
  const raw = span / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= raw * 0.999);
  const values = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * span; k++) values.push(k * step);
  return values;
}

// Amplitude spectrum by Welch's method (1967): Hann windows that overlap by half, powers averaged.

const SHORTEST = 128;
const LONGEST = 4096;
const LOBES = 6;
const LEAST = 0.002;

/** In-place radix-2 transform of re + i im, whose length is a power of two. */
function fft(re, im) {
  const n = re.length;
  for (let i = 1, j = 0; i < n; i++) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [re[i], re[j]] = [re[j], re[i]];
      [im[i], im[j]] = [im[j], im[i]];
    }
  }
  for (let size = 2; size <= n; size *= 2) {
    const half = size / 2;
    for (let k = 0; k < half; k++) {
      const cos = Math.cos((2 * Math.PI * k) / size), sin = -Math.sin((2 * Math.PI * k) / size);
      for (let i = k; i < n; i += size) {
        const j = i + half;
        const r = re[j] * cos - im[j] * sin, q = re[j] * sin + im[j] * cos;
        re[j] = re[i] - r; im[j] = im[i] - q;
        re[i] += r; im[i] += q;
      }
    }
  }
}

/** Values at an even pace, and the part of them that was missing: what is lost or invalid is put on
 * the line between its neighbours. */
function even(t, v, period_s) {
  const good = [];
  for (let i = 0; i < t.length; i++) if (!Number.isNaN(v[i])) good.push(i);
  if (good.length < SHORTEST) return null;
  const begin = t[good[0]], n = Math.floor((t[good[good.length - 1]] - begin) / period_s + 1.5);
  const out = new Float64Array(n);
  for (let i = 0, g = 0; i < n; i++) {
    const at = begin + i * period_s;
    while (g < good.length - 2 && t[good[g + 1]] < at) g++;
    const a = good[g], b = good[g + 1];
    out[i] = v[a] + ((v[b] - v[a]) * (at - t[a])) / (t[b] - t[a]);
  }
  return { values: out, missing: 1 - good.length / n };
}

/** Frequencies in Hz and amplitudes (of a sine, its peak) in the unit of v, and the part of the
 * samples that is missing; null if there are too few. */
export function spectrum(t, v, period_s) {
  const evened = even(t, v, period_s);
  if (!evened) return null;
  const { values, missing } = evened;
  let n = SHORTEST;
  while (n * 2 <= values.length && n < LONGEST) n *= 2;
  const window = Float64Array.from({ length: n }, (_, i) => 0.5 - 0.5 * Math.cos((2 * Math.PI * i) / n));
  const power = new Float64Array(n / 2);
  let count = 0;
  for (let begin = values.length - n; begin >= 0; begin -= n / 2, count++) {
    const part = values.subarray(begin, begin + n);
    const mean = part.reduce((sum, value) => sum + value, 0) / n;
    const re = part.map((value, i) => (value - mean) * window[i]), im = new Float64Array(n);
    fft(re, im);
    for (let k = 0; k < n / 2; k++) power[k] += re[k] ** 2 + im[k] ** 2;
  }
  const step_hz = 1 / (n * period_s);
  return {
    missing,
    step_hz,
    hz: Float64Array.from(power, (_, k) => k * step_hz),
    // The mean of the Hann window is 1/2, and a sine has half of its amplitude at each frequency.
    amplitude: power.map((p) => (4 * Math.sqrt(p / count)) / n),
  };
}

/** The strongest peaks that stand out of the noise and are no side lobes of a stronger one: those
 * of a Hann window are under LEAST beyond LOBES lines.
 *
 * Between the lines by the ratio of the two highest, which is exact for a sine in a Hann window
 * (Grandke 1983). */
export function peaks({ amplitude, step_hz }, most) {
  const sorted = Float64Array.from(amplitude).sort();
  const floor = 5 * sorted[sorted.length >> 1];
  const found = [];
  for (let k = 2; k < amplitude.length - 2; k++) {
    const a = amplitude[k];
    if (a < floor || a < Math.max(...amplitude.subarray(Math.max(k - LOBES, 0), k + LOBES + 1))) continue;
    const up = amplitude[k + 1] > amplitude[k - 1];
    const ratio = (up ? amplitude[k + 1] : amplitude[k - 1]) / a;
    const off = Math.min(Math.max((2 * ratio - 1) / (ratio + 1), 0), 0.5);
    const loss = off < 1e-6 ? 1 : (Math.PI * off * (1 - off * off)) / Math.sin(Math.PI * off);
    found.push({ hz: (k + (up ? off : -off)) * step_hz, amplitude: a * loss });
  }
  found.sort((p, q) => q.amplitude - p.amplitude);
  return found.filter((p) => p.amplitude >= LEAST * found[0].amplitude).slice(0, most);
}

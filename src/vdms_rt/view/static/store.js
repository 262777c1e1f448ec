// The last ten minutes of a marker, in arrays that never grow.

export const SPAN_S = 600;
const CAPACITY = 1 << 16;
const COLUMNS = ["t_s", "seq", "x", "y", "sigma_x", "sigma_y"];

/** A ring in which each value is written twice, so that any stretch of it is one subarray. */
export class Store {
  constructor() {
    for (const name of COLUMNS) this[name] = new Float64Array(2 * CAPACITY);
    this.clear();
  }

  clear() {
    this.begin = 0;
    this.end = 0;
    this.session = "";
    this.last_seq = null;
    this.status = 0;
  }

  add(samples) {
    for (let i = 0; i < samples.count; i++) {
      const t_s = samples.t_s[i];
      this.last_seq = samples.seq[i];
      // The plots need rising times; a corrected order of fields swaps two once.
      if (this.end > this.begin && t_s <= this.newest("t_s")) continue;
      const at = this.end % CAPACITY;
      for (const name of COLUMNS) {
        this[name][at] = samples[name][i];
        this[name][at + CAPACITY] = samples[name][i];
      }
      this.end++;
    }
    if (samples.count) this.status = samples.status[samples.count - 1];
    this.begin = Math.max(this.begin, this.end - CAPACITY);
    this.begin = this.place(this.newest("t_s") - SPAN_S);
  }

  get count() {
    return this.end - this.begin;
  }

  newest(name) {
    return this.count ? this[name][(this.end - 1) % CAPACITY] : NaN;
  }

  oldest(name) {
    return this.count ? this[name][this.begin % CAPACITY] : NaN;
  }

  /** The place of the first sample at or after t_s. */
  place(t_s) {
    let low = this.begin, high = this.end;
    while (low < high) {
      const middle = Math.floor((low + high) / 2);
      if (this.t_s[middle % CAPACITY] < t_s) low = middle + 1; else high = middle;
    }
    return low;
  }

  /** A view, not a copy, of a column from one time to another. */
  between(name, from_s, to_s) {
    return this.slice(name, this.place(from_s), this.place(to_s));
  }

  slice(name, begin, end) {
    const at = begin % CAPACITY;
    return this[name].subarray(at, at + Math.max(end - begin, 0));
  }

  /** Samples a second, from the newest ones. */
  rate_hz() {
    const n = Math.min(this.count - 1, 120);
    if (n < 2) return NaN;
    const t = this.slice("t_s", this.end - n - 1, this.end);
    return n / (t[n] - t[0]);
  }

  /** Time from one sample to the next where none is lost: the median of the newest. */
  period_s() {
    const n = Math.min(this.count - 1, 31);
    if (n < 3) return 1 / 30;
    const t = this.slice("t_s", this.end - n - 1, this.end);
    const steps = Array.from({ length: n }, (_, i) => t[i + 1] - t[i]).sort((a, b) => a - b);
    return steps[n >> 1];
  }
}

/** Peak, peak-to-peak and rms about the mean of the finite values. */
export function figures(values) {
  let count = 0, sum = 0, low = Infinity, high = -Infinity;
  for (const v of values) {
    if (Number.isNaN(v)) continue;
    count++;
    sum += v;
    if (v < low) low = v;
    if (v > high) high = v;
  }
  if (!count) return null;
  const mean = sum / count;
  let squares = 0;
  for (const v of values) if (!Number.isNaN(v)) squares += (v - mean) ** 2;
  return { peak: Math.max(Math.abs(low), Math.abs(high)), span: high - low, rms: Math.sqrt(squares / count), mean, low, high };
}

// Keeps the stream on one grid of columns: the newest ones of every signal of every axis.

// a message is a length, a header in JSON, then minimum and maximum of every column
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let place = 4 + length;
  for (const part of header.parts) {
    const size = part.columns * part.signals;
    part.low = new Float32Array(buffer, place, size);
    part.high = new Float32Array(buffer, place + 4 * size, size);
    place += 8 * size;
  }
  return header;
}

export class Columns {
  constructor(begin, count) {
    this.width = begin.ticks_per_column;
    this.period_s = begin.sync_period_s;
    this.signals = begin.signals;
    this.count = count;
    this.end = null;  // the column after the newest
    this.kept = new Map(begin.axes.map((axis) => [axis, begin.signals.map(() => ({low: empty(count), high: empty(count)}))]));
    this.x = Array.from({length: count}, (_, k) => (k - count + 0.5) * this.width * this.period_s);
  }

  get end_tick() { return this.end === null ? null : this.end * this.width; }

  take(header) {
    for (const part of header.parts) {
      const first = part.first_tick / this.width, wide = part.per_column / this.width;
      this.reach(first + part.columns * wide);
      this.kept.get(part.axis).forEach((signal, s) => {
        for (let k = 0; k < part.columns; k++) {
          const place = first + k * wide - this.end + this.count;
          const from = Math.max(0, place), to = Math.max(0, place + wide);
          signal.low.fill(part.low[s * part.columns + k], from, to);
          signal.high.fill(part.high[s * part.columns + k], from, to);
        }
      });
    }
  }

  // move the grid so that it ends with this column; older ones are dropped
  reach(end) {
    if (this.end === null) this.end = end;
    const step = Math.min(this.count, end - this.end);
    if (step <= 0) return;
    this.end = end;
    for (const signals of this.kept.values()) {
      for (const {low, high} of signals) {
        for (const values of [low, high]) {
          values.copyWithin(0, step);
          values.fill(NaN, this.count - step);
        }
      }
    }
  }

  copy() {
    const twin = Object.assign(Object.create(Columns.prototype), this);
    twin.kept = new Map([...this.kept].map(([axis, signals]) => [axis, signals.map(({low, high}) => ({low: low.slice(), high: high.slice()}))]));
    return twin;
  }

  // the values of a signal for a chart: null for missing ones
  of(axis, s) {
    const {low, high} = this.kept.get(axis)[s];
    return {low: Array.from(low, known), high: Array.from(high, known)};
  }

  // the middle of the newest column that has a value, within half a second
  newest(axis, s) {
    const {low, high} = this.kept.get(axis)[s];
    const oldest = Math.max(0, this.count - 1 - Math.ceil(0.5 / (this.width * this.period_s)));
    for (let k = this.count - 1; k >= oldest; k--) if (!Number.isNaN(low[k])) return (low[k] + high[k]) / 2;
    return null;
  }
}

const empty = (count) => new Float32Array(count).fill(NaN);
const known = (value) => (Number.isNaN(value) ? null : value);

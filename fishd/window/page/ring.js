// What a page keeps of ten minutes: the latest ticks, and of all of them the extremes of short bins.
/** Time that charts can show [s], and the time that they show tick by tick [s]. */
export const KEPT_S = 600, EVERY_TICK_S = 120;
/** Length of a bin, of which each column keeps its lowest and its highest value, as in past.py [s]. */
const BIN_S = 0.5;
const MIN_ROWS = 2400, MAX_ROWS = 24_000, SPARE_ROWS = 256;
const MAX_COLUMNS = 64;
const CLOCK_JUMP_S = 1;
/** Time for which lost ticks are counted [s]. */
const LOST_S = 120;
/** Part of a span that may lack its oldest ticks and is still shown tick by tick. */
const MISSING = 0.05;
/** Prefixes of the columns of a controller's quantity and of a sensor's reading. */
export const QUANTITY = "quantity:", READING = "reading:";

/** Columns of fixed length, in which each further row replaces the oldest; NaN where there is no value. */
class Columns {
  /** capacity: number of rows; period: time between two of them [s] */
  constructor(capacity, period) {
    Object.assign(this, { capacity, period });
    this.clear();
  }

  clear() {
    this.rows = 0;
    this.next = 0;
    this.columns = new Map();
  }

  /** Return the time of the oldest row; infinite if there is none. */
  get oldest() {
    return this.rows ? this.value("time", this.rows) : Infinity;
  }

  /** Return the value of a column in the newest row (age 1) or an older one. */
  value(name, age) {
    return this.columns.get(name)?.[(this.next - age + this.capacity) % this.capacity] ?? NaN;
  }

  /** Return whether a column has ever had a value. */
  has(name) {
    return this.columns.has(name);
  }

  /** Return how many rows have more than this value in a column that only grows. */
  newer(value, name = "time") {
    let low = 0, high = this.rows;
    while (low < high) {
      const age = (low + high + 1) >> 1, there = this.value(name, age);
      if ((Number.isNaN(there) ? this.value(name, age + 1) : there) > value) low = age;
      else high = age - 1;
    }
    return low;
  }

  /** Copy a column into an array, whose end is `skip` rows older than the newest; null where there is none. */
  copy(name, target, factor = 1, skip = 0) {
    const column = this.columns.get(name), { length } = target;
    const filled = column ? Math.max(0, Math.min(this.rows - skip, length)) : 0;
    target.fill(null, 0, length - filled);
    for (let i = length - filled, row = (this.next - skip - filled + 2 * this.capacity) % this.capacity; i < length; i++) {
      const value = column[row];
      target[i] = Number.isNaN(value) ? null : value * factor;
      if (++row === this.capacity) row = 0;
    }
  }

  /** Copy the times; rows that are not filled yet continue the time backwards. */
  copyTimes(target, skip = 0) {
    this.copy("time", target, 1, skip);
    const first = target.length - Math.max(0, Math.min(this.rows - skip, target.length));
    for (let i = first - 1; i >= 0; i--) target[i] = (target[i + 1] ?? 0) - this.period;
  }

  addRow(time) {
    const row = this.next;
    for (const column of this.columns.values()) column[row] = NaN;
    this.next = (row + 1) % this.capacity;
    this.rows = Math.min(this.rows + 1, this.capacity);
    this.columnOf("time")[row] = time;
    return row;
  }

  /** Return a column, which is made if it is new; one too many is not kept. */
  columnOf(name) {
    if (!this.columns.has(name)) {
      if (this.columns.size >= MAX_COLUMNS) return [];
      this.columns.set(name, new Float64Array(this.capacity).fill(NaN));
    }
    return this.columns.get(name);
  }
}

/** The lowest and the highest value of each bin, in two rows; a row without values where ticks are missing. */
class Past extends Columns {
  constructor(gap) {
    super(2 * Math.ceil(KEPT_S / BIN_S) + SPARE_ROWS, 0.5 * BIN_S);
    Object.assign(this, { gap, bin: -Infinity });
  }

  /** Add values at a time, unless they are of an earlier bin. */
  add(time, values) {
    const bin = Math.floor(time / BIN_S);
    if (bin < this.bin) return;
    if (bin > this.bin) {
      if (time - this.time > this.gap) this.addRow(0.5 * (time + this.time));
      this.bin = bin;
      this.low = this.addRow((bin + 0.25) * BIN_S);
      this.high = this.addRow((bin + 0.75) * BIN_S);
    }
    this.time = time;
    for (const name in values) {
      if (name === "time") continue;
      const column = this.columnOf(name), value = values[name];
      if (!(column[this.low] <= value)) column[this.low] = value;
      if (!(column[this.high] >= value)) column[this.high] = value;
    }
  }
}

/** The latest ticks; a row of NaN where some were lost. */
export class Ring extends Columns {
  constructor(period) {
    super(Math.min(MAX_ROWS, Math.max(MIN_ROWS, Math.ceil(KEPT_S / period))) + SPARE_ROWS, period);
  }

  clear() {
    super.clear();
    const gap = Math.max(1, 4 * this.period);
    Object.assign(this, { gap, past: new Past(gap + BIN_S), lost: 0, latest: null });
  }

  /** Add a tick; a gap before it becomes a row without values. */
  push(tick) {
    const before = this.latest;
    if (before) {
      if (tick.time < before.time - CLOCK_JUMP_S) this.clear();
      else if (tick.time <= before.time) return;
      else if (tick.seq !== before.seq + 1 || tick.time - before.time > this.gap) {
        if (tick.seq > before.seq + 1) {
          this.lost += tick.seq - before.seq - 1;
          this.lostAt = tick.time;
        }
        this.addRow(0.5 * (tick.time + before.time));
      }
    }
    if (this.lost && tick.time - this.lostAt > LOST_S) this.lost = 0;
    const row = this.addRow(tick.time), values = valuesOf(tick);
    for (const name in values) this.columnOf(name)[row] = values[name];
    this.past.add(tick.time, values);
    this.latest = tick;
  }

  /** Return the ticks if they cover a span that is not too long to draw them, else the bins. */
  level(low, high) {
    const isCovered = this.oldest <= low + MISSING * (high - low) || this.oldest < this.past.oldest + BIN_S;
    return high - low <= EVERY_TICK_S && isCovered ? this : this.past;
  }

  /** Return the number of the first tick at or after a time; null if it is not kept. */
  seqAt(time) {
    let age = time >= this.oldest - this.period ? this.newer(time - 0.5 * this.period) : 0;
    if (Number.isNaN(this.value("seq", age))) age--; // a gap
    return age >= 1 ? this.value("seq", age) : null;
  }

  /** Return the time of a tick, or of its bin; NaN if it is not kept. */
  timeOf(seq) {
    const level = this.value("seq", this.rows) <= seq ? this : this.past;
    const isKept = level.value("seq", level.rows) <= seq && seq <= this.latest.seq;
    return isKept ? level.value("time", level.newer(seq - 0.5, "seq")) : NaN;
  }

  /** Return the unix time of a time. */
  unixTime(time) {
    const level = time >= this.oldest ? this : this.past;
    const t = level.value("t", Math.max(1, level.newer(time - 0.5 * level.period)));
    return Number.isNaN(t) && this.latest ? this.latest.t - this.latest.time + time : t;
  }
}

/** Return the values of a tick by the names of their columns. */
function valuesOf(tick) {
  const values = {}, { thrust, thrust_ci95: half } = tick;
  const take = (prefix, named) => {
    for (const name in named) if (typeof named[name] === "number") values[prefix + name] = named[name];
  };
  take("", tick);
  take(QUANTITY, tick.quantities);
  take(READING, tick.readings);
  if (tick.servo_on === false) delete values.phi_c;
  if (tick.suspect) Object.assign(values, { suspect_fx: tick.fx, suspect_fy: tick.fy });
  if (half != null) Object.assign(values, { thrust_low: thrust - half, thrust_high: thrust + half });
  return values;
}

/** Yield the ticks, or the rows of bins, that columns of the history hold. */
export function* ticksOf({ quantities = {}, readings = {}, ...columns }) {
  const at = (named, row) =>
    Object.fromEntries(Object.entries(named).map(([name, column]) => [name, column[row]]).filter(([, value]) => value != null));
  for (let row = 0; row < columns.seq.length; row++) {
    yield { ...at(columns, row), quantities: at(quantities, row), readings: at(readings, row) };
  }
}

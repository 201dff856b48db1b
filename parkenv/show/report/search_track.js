// A recorded search over time: where the car is, what it believes, what it has cost.

const PARK = 4;

/** Return the last index whose value is at most a limit, -1 if none. */
function lastUpTo(values, limit) {
  let [low, high] = [0, values.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] <= limit) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** Return the colour of a term of the costs; the style sheet has a variable for each. */
const termColor = ({ name }) => `var(--${name.replace("_", "-")})`;

/** Return the terms of the costs that are charged once the car stands. */
const termsAfterDrive = () => data.terms.filter(({ field }) => !["drive_s", "failed_s"].includes(field));

/** One search over time. */
class Track {
  constructor(search, world, lot) {
    this.search = search;
    this.world = world;
    this.lot = lot;
    this.end = search.t[search.t.length - 1] / 100;
    this.plans = [];
    let plan = [];
    search.plan.forEach((next, k) => {
      if (next !== null) plan = next;
      else if (k > 0 && search.vertex[k] !== search.vertex[k - 1]) plan = plan.slice(1);
      this.plans.push(plan);
    });
    this.rewind();
  }

  rewind() {
    this.applied = 0;
    this.belief = Uint8Array.from(this.world.forecast);
    this.seen = new Uint8Array(this.lot.slots.length);
  }

  /** Return the last recorded moment at or before a time, with belief and observed slots updated to it. */
  at(seconds) {
    const k = Math.max(0, lastUpTo(this.search.t, Math.round(100 * seconds + 1e-6)));
    if (k + 1 < this.applied) this.rewind();
    for (; this.applied <= k; this.applied += 1) {
      const changes = this.search.belief[this.applied];
      for (let i = 0; i < changes.length; i += 2) this.belief[changes[i]] = changes[i + 1];
      for (const slot of this.search.seen[this.applied]) this.seen[slot] = 1;
    }
    return k;
  }

  /** Return the car's pose at a time. */
  pose(seconds, k) {
    const { search, lot } = this;
    const [x, y] = lot.vertices[search.vertex[k]];
    if (k + 1 < search.vertex.length && search.vertex[k + 1] !== search.vertex[k]) {
      const [bx, by] = lot.vertices[search.vertex[k + 1]];
      const [from, to] = [search.t[k] / 100, search.t[k + 1] / 100];
      const share = to > from ? Math.min((seconds - from) / (to - from), 1) : 1;
      return [x + share * (bx - x), y + share * (by - y), Math.atan2(by - y, bx - x)];
    }
    for (let i = k; i > 0; i -= 1) {
      if (search.vertex[i] !== search.vertex[i - 1]) {
        const [ax, ay] = lot.vertices[search.vertex[i - 1]];
        return [x, y, Math.atan2(y - ay, x - ax)];
      }
    }
    return [x, y, lot.yaw[search.vertex[k]] ?? 0];
  }

  /** Split the elapsed time into its parts, s. */
  split(seconds, k) {
    const { search } = this;
    let failed = search.failed[k] / 100;
    const now = Math.min(seconds, this.end);
    if (k + 1 < search.t.length && search.failed[k + 1] > search.failed[k]) failed += now - search.t[k] / 100;
    const parts = { drive_s: now - failed, failed_s: failed };
    let rest = Math.max(0, seconds - this.end);
    for (const { field } of termsAfterDrive()) rest -= parts[field] = Math.min(rest, search.costs[field]);
    return parts;
  }

  status(seconds, k) {
    const { search, lot } = this;
    const name = (slot) => `slot ${lot.slot_ids[slot]}`;
    if (seconds >= search.total_s - 0.005) return search.parked ? `at the goal; parked in ${name(search.slot)}` : search.truncated ? "truncated" : "lot full, gave up";
    if (seconds >= this.end) return search.parked ? `parked in ${name(search.slot)}, walking` : search.truncated ? "truncated" : "lot is full: giving up";
    const here = search.vertex[k];
    if (search.action[k] === PARK) return here < lot.slots.length && search.failed[k + 1] > search.failed[k] ? `${name(here)} is taken: failed attempt` : "waiting";
    if (search.vertex[k + 1] === here) return "waiting";
    const plan = this.plans[k];
    const end = plan[plan.length - 1];
    return plan.length && end < lot.slots.length ? `driving, toward ${name(end)}` : "driving";
  }
}

function seconds2(value) {
  return value >= 1000 ? value.toFixed(0) : value.toFixed(1);
}

// A search of parkenv/Search-v2 in the browser: the same steps, observations and costs as in Python, to the last bit or so.

const WORD = (1n << 64n) - 1n;
const GOLDEN = 0x9e3779b97f4a7c15n;
const [OBSERVATION_STREAM, VIEW_STREAM] = [3, 4];

function mix64(word) {
  let z = word & WORD;
  z = ((z ^ (z >> 30n)) * 0xbf58476d1ce4e5b9n) & WORD;
  z = ((z ^ (z >> 27n)) * 0x94d049bb133111ebn) & WORD;
  return z ^ (z >> 31n);
}

/** Return the uniform random number of (key, stream, slot, index): parkenv.compiled.keyed_random. */
function keyedUniform(key, ...numbers) {
  const hash = numbers.reduce((h, number) => mix64(h + GOLDEN * BigInt(number)), key);
  return (Number(hash >> 12n) + 0.5) * 2 ** -52;
}

/** Return numbers from the base64 text of float64. */
function floats(text) {
  return new Float64Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
}

/** Decode the arrays of a search problem and its worlds. */
function unpackGame({ problem, worlds }) {
  for (const name of ["seconds", "walk_s", "parking_cost_s"]) problem[name] = floats(problem[name]);
  problem.rates &&= problem.rates.map(floats);
  for (const world of worlds) {
    for (const name of ["forecast", "decay_rate"]) world[name] = floats(world[name]);
    const times = floats(world.changes.times);
    let first = 0;
    world.changes = world.changes.counts.map((count) => times.subarray(first, (first += count)));
    world.takenFirst = new Uint8Array(problem.lot.slots.length);
    for (const slot of world.taken) world.takenFirst[slot] = 1;
    world.key = BigInt(world.key);
  }
}

/** Whether a slot is taken at a time, s since Monday 00:00: hidden from the driver. */
function isTaken(world, slot, time) {
  return Boolean((world.takenFirst[slot] + lastUpTo(world.changes[slot], time) + 1) & 1);
}

class GameSearch {
  constructor(problem, world, terms) {
    const n = problem.lot.slots.length;
    Object.assign(this, { problem, world, n, time: world.arrival_s, vertex: world.entry, parked: false, over: false, truncated: false });
    this.costs = Object.fromEntries(terms.map(({ field }) => [field, 0]));
    this.actions = "";
    this.observedAt = new Float64Array(n).fill(-1);
    this.observedTaken = new Uint8Array(n);
    this.pObserved = Float64Array.from(world.forecast);
    this.record = { t: [], vertex: [], failed: [], action: [], belief: [], seen: [], plan: [] };
    this.keep();
  }

  get elapsed() {
    return this.time - this.world.arrival_s;
  }

  get total() {
    return Object.values(this.costs).reduce((sum, cost) => sum + cost, 0);
  }

  target(action, vertex = this.vertex) {
    return action < PARK ? this.problem.targets[4 * vertex + action] : -1;
  }

  /** Return P(taken) of a slot now, as the car believes. */
  belief(slot) {
    const { forecast, decay_rate: rate } = this.world;
    const age = this.elapsed - this.observedAt[slot];
    return forecast[slot] + (this.pObserved[slot] - forecast[slot]) * Math.exp(-rate[slot] * age);
  }

  seen(slot) {
    return this.observedAt[slot] >= 0;
  }

  observe(slot, taken, p) {
    this.observedTaken[slot] = taken;
    this.pObserved[slot] = p;
    this.observedAt[slot] = this.elapsed;
  }

  /** Observe the slots in view, with the misses and errors of the sensor. */
  observeView() {
    const { view_starts: starts, viewed, rates } = this.problem;
    const millisecond = Math.trunc(this.time * 1000);
    for (let i = starts[this.vertex]; i < starts[this.vertex + 1]; i += 1) {
      const slot = viewed[i];
      const really = isTaken(this.world, slot, this.time);
      if (!rates) {
        this.observe(slot, really, really ? 1 : 0);
        continue;
      }
      const [seen, hit, falseAlarm] = rates.map((rate) => rate[i]);
      if (keyedUniform(this.world.key, VIEW_STREAM, slot, 0) >= seen) continue;
      const taken = keyedUniform(this.world.key, OBSERVATION_STREAM, slot, millisecond) < (really ? hit : falseAlarm);
      const [ifTaken, ifFree] = taken ? [hit, falseAlarm] : [1 - hit, 1 - falseAlarm];
      const p = this.belief(slot);
      const evidence = ifTaken * p + ifFree * (1 - p);
      this.observe(slot, taken, evidence > 0 ? (ifTaken * p) / evidence : Number(taken));
    }
  }

  /** Take an action of Search-v2: 0 to 3 drive up, down, left, right, or wait where there is no edge; 4 parks. */
  step(action) {
    const { problem, vertex } = this;
    const step = Object.fromEntries(Object.keys(this.costs).map((field) => [field, 0]));
    step.drive_s = problem.seconds[5 * vertex + action];
    const target = this.target(action);
    if (target >= 0) this.vertex = target;
    else if (action === PARK && vertex < this.n) {
      const taken = isTaken(this.world, vertex, this.time);
      this.parked = !taken;
      if (taken) step.failed_s = problem.failure_s;
      else [step.walk_s, step.parking_cost_s] = [problem.walk_s[vertex], problem.parking_cost_s[vertex]];
      this.observe(vertex, taken, taken ? 1 : 0);
    }
    this.time += step.drive_s + step.failed_s;
    this.actions += action;
    if (!this.parked) this.observeView();
    const full = this.observedTaken.every((taken) => taken);
    this.over = full || this.parked;
    this.truncated = !this.over && this.actions.length >= problem.step_limit;
    if (full || this.truncated) step.gave_up_s = problem.give_up_s;
    this.over ||= this.truncated;
    for (const field of Object.keys(this.costs)) this.costs[field] += step[field];
    this.record.action.push(action);
    this.keep();
  }

  /** Keep the moment for the replay. */
  keep() {
    const { record } = this;
    record.t.push(Math.round(100 * this.elapsed));
    record.vertex.push(this.vertex);
    record.failed.push(Math.round(100 * this.costs.failed_s));
    record.belief.push([]);
    record.seen.push([]);
    if (record.action.length) record.plan.push([]);
  }

  /** Take actions, a digit each, until the search is over. */
  take(actions) {
    for (const action of actions) if (!this.over) this.step(Number(action));
    return this;
  }

  /** What Python knows of the search, too. */
  get state() {
    const belief = Array.from({ length: this.n }, (_, slot) => this.belief(slot));
    return { total_s: this.total, vertex: this.vertex, steps: this.actions.length, over: this.over, belief };
  }

  /** Return the search so far for a Track. */
  recording(agent) {
    const { parked, truncated, costs, total } = this;
    return { ...this.record, agent, parked, truncated, costs, total_s: total, slot: parked ? this.vertex : null };
  }

  /** Return the actions of the shortest drive to a vertex; null if there is none. */
  route(goal) {
    const best = new Map([[this.vertex, [0, "" ]]]);
    const open = new Set(best.keys());
    while (open.size) {
      const here = [...open].reduce((a, b) => (best.get(a)[0] <= best.get(b)[0] ? a : b));
      const [seconds, actions] = best.get(here);
      if (here === goal) return actions;
      open.delete(here);
      for (let action = 0; action < PARK; action += 1) {
        const next = this.target(action, here);
        const after = seconds + this.problem.seconds[5 * here + action];
        if (next < 0 || after >= (best.get(next)?.[0] ?? Infinity)) continue;
        best.set(next, [after, actions + action]);
        open.add(next);
      }
    }
    return null;
  }
}

// The list of robots: what is looked for, in which order, and which robots are marked for what is done to several.
import { SvelteSet } from 'svelte/reactivity';
import { between, countsOf, listed, modelOf, type Group, type Order } from '../roster';
import type { Fleet, RobotView } from './fleet.svelte';

/** How long the order stays after a key was pressed in the list, milliseconds. */
const STAYS_MS = 3_000;

export class Roster {
  search = $state('');
  readonly groups = new SvelteSet<Group>();
  model = $state<string | null>(null);
  tag = $state<string | null>(null);
  order = $state<Order>('trouble');
  /** Robots that are marked. */
  readonly marked = new SvelteSet<string>();
  /** The row that keys move from. */
  active = $state<string | null>(null);
  /** A pointer is over the list: what it points at stays there. */
  isPointedAt = $state(false);
  /** The robot whose row is pointed at or has the focus: the map names it, however crowded it is. */
  named = $state<string | null>(null);

  /** Where a range begins. */
  #anchor: string | null = null;
  #keyAt = $state(-Infinity);
  #last: string[] = [];
  #lastKey = '';

  readonly #hasStopProblem = (robot: string) => this.fleet.stops.problemOf(robot) !== null;

  constructor(readonly fleet: Fleet) {}

  readonly counts = $derived.by(() => countsOf(this.fleet.robots.map((entry) => entry.robot), this.#hasStopProblem));
  readonly models = $derived.by(() => [...new Set(this.fleet.robots.map((entry) => modelOf(entry.robot)))].sort());
  readonly tags = $derived.by(() => [...new Set(this.fleet.robots.flatMap((entry) => entry.robot.tags ?? []))].sort());
  readonly shown = $derived.by((): RobotView[] => {
    const { robots, site } = this.fleet;
    const { search, model, tag, order } = this;
    const groups = new Set(this.groups);
    const key = JSON.stringify([site, search, [...groups], model, tag, order]);
    const isHeld = this.isPointedAt || this.fleet.now - this.#keyAt < STAYS_MS;
    if (isHeld && key === this.#lastKey) {
      const known = this.fleet.byId;
      return this.#last.flatMap((id) => known.get(id) ?? []);
    }
    const found = listed(robots, { search, groups, model, tag, order }, this.fleet.nameRanks, this.#hasStopProblem);
    this.#last = found.map((entry) => entry.id);
    this.#lastKey = key;
    return found;
  });
  /** Robots that are marked and there. */
  readonly chosen = $derived.by(() => this.fleet.robots.filter((entry) => this.marked.has(entry.id)));
  readonly areAllMarked = $derived.by(() => this.shown.length > 0 && this.shown.every((entry) => this.marked.has(entry.id)));

  get isFiltered(): boolean {
    return this.search.trim() !== '' || this.groups.size > 0 || this.model !== null || this.tag !== null;
  }

  /** Robots that a Stop of a selection is for: those that are marked, or the one that is open. */
  get targets(): string[] {
    if (this.fleet.selected) return [this.fleet.selected];
    return this.chosen.map((entry) => entry.id);
  }

  toggleGroup(group: Group): void {
    if (!this.groups.delete(group)) this.groups.add(group);
  }

  everything(): void {
    this.search = '';
    this.groups.clear();
    this.model = null;
    this.tag = null;
  }

  toggle(id: string): void {
    if (!this.marked.delete(id)) this.marked.add(id);
    this.#anchor = id;
    this.active = id;
    this.fleet.isDirty = true;
  }

  /** Marks from where the last choice was to here. */
  reach(id: string): void {
    const ids = this.shown.map((entry) => entry.id);
    for (const found of between(ids, this.#anchor ?? this.active, id)) this.marked.add(found);
    this.#anchor ??= id;
    this.active = id;
    this.fleet.isDirty = true;
  }

  /** Marks all that the list shows, or none of them. */
  markShown(isMarked: boolean): void {
    for (const { id } of this.shown) {
      if (isMarked) this.marked.add(id);
      else this.marked.delete(id);
    }
    this.fleet.isDirty = true;
  }

  unmark(): void {
    this.marked.clear();
    this.#anchor = null;
    this.fleet.isDirty = true;
  }

  /** Moves the row that has the keys; gives the robot of the row, or null if there is none. */
  step(by: number, isReaching: boolean): string | null {
    const ids = this.shown.map((entry) => entry.id);
    const from = this.active === null ? -1 : ids.indexOf(this.active);
    const at = Math.min(ids.length - 1, Math.max(0, from + by));
    const id = ids[at] ?? null;
    if (id === null) return null;
    if (isReaching) {
      this.#anchor ??= this.active;
      this.reach(id);
    }
    this.active = id;
    return id;
  }

  /** A key was pressed in the list. */
  pressed(): void {
    this.#keyAt = performance.now();
  }

  /** Another site has other robots. */
  changeSite(): void {
    this.unmark();
    this.active = null;
    this.everything();
  }
}


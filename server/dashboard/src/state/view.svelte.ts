// What is shown: tabs, layers of the map, the mission that is looked at.
import type { CellFriction, MissionDetail, PlannedPath, RobotModel } from '../api/schema';
import { LAYER_FIRST } from '../address';
import { ask, list, saidOf, type Listed } from '../api/client';
import type { Said } from '../message';
import { Layer, type Quantity } from '../map/friction';
import type { Bounds, PointM } from '../map/camera';
import { modelLabel } from '../map/models';
import { serves, windowOn, type Window } from '../map/window';
import { hasEnded, type Fleet } from './fleet.svelte';
import { Compare } from './compare.svelte';
import { MapTime } from './map_time.svelte';
import { Plans } from './plans';
import { Replay } from './replay.svelte';

export type Tab = 'robots' | 'missions' | 'alerts' | 'terrains';

/** Least time between two looks at the friction map while it changes, milliseconds. */
const CHANGED_MS = 3_000;
/** Time between two looks while it does not: ages grow, milliseconds. */
const FRICTION_MS = 60_000;
/** Entries of the friction map that the page reads; the API gives them in pages of 1000. */
const CELLS_MAX = 20_000;
/** Squares of the part that is read; one that several terrains or models share has several entries. */
const SQUARES_MAX = 16_000;
/** Scale at which a single place is shown, pixels per metre. */
export const PLACE_SCALE = 40;
/** Wait after the map was moved before another part is read, milliseconds. */
const MOVED_MS = 300;

export class View {
  tab = $state<Tab>('robots');
  showTerrains = $state(true);
  showFence = $state(true);
  showTrails = $state(true);
  quantity = $state<Quantity | null>(LAYER_FIRST);
  configuration = $state<string | null>(null);
  /** Robot models that the friction map knows. */
  configurations = $state.raw<string[]>([]);
  layer = $state.raw<Layer | null>(null);
  frictionProblem = $state<Said | null>(null);
  isReading = $state(false);
  isWhole = $state(true);
  /** The alert that is shown and marked among the others; null for none. */
  alert = $state<string | null>(null);
  detail = $state.raw<MissionDetail | null>(null);
  detailProblem = $state<Said | null>(null);
  /** The smooth path of the mission that is looked at, once it is known. */
  plan = $state.raw<PlannedPath | null>(null);
  /** Its time line, once it has ended. */
  replay = $state.raw<Replay | null>(null);
  /** The place of the friction map that somebody looks at; null for none. */
  inspected = $state.raw<PointM | null>(null);
  /** What the map shows, once it is known: its middle, and pixels per metre. */
  place = $state.raw<{ center: PointM; scale: number } | null>(null);
  /** A wish to the map: to show just this part. */
  wantedPlace = $state.raw<{ center: PointM; scale: number } | null>(null);
  /** A wish to the map: to show this, counted so that the same can be wished again. */
  wanted = $state.raw<{ points: PointM[] } | null>(null);

  #cells: CellFriction[] = [];
  /** Number of the last mission that was asked for. */
  #asked = 0;
  /** What of the map can be seen, and what of it was read. */
  #seen: Bounds | null = null;
  #window: Window | null = null;
  #due: ReturnType<typeof setTimeout> | undefined;
  #changed: ReturnType<typeof setTimeout> | undefined;
  /** Another part or time of the map was wanted while one was read. */
  #readAgain = false;
  readonly #timer: ReturnType<typeof setInterval>;

  readonly plans: Plans;
  /** The change between two times, shown instead of a quantity. */
  readonly compare: Compare;
  /** The time of the map that a quantity is shown of. */
  readonly time = new MapTime(() => this.readFriction());

  constructor(readonly fleet: Fleet) {
    this.plans = new Plans(() => (fleet.isDirty = true));
    this.compare = new Compare(fleet);
    this.#timer = setInterval(() => this.#again(), FRICTION_MS);
    fleet.mapChanged = () => {
      this.#changed ??= setTimeout(() => {
        this.#changed = undefined;
        this.#again();
      }, CHANGED_MS);
    };
  }

  /** The past does not change. */
  #again(): void {
    if (this.quantity !== null && this.time.at_ms === null) void this.readFriction();
  }

  choose(quantity: Quantity | null): void {
    this.quantity = quantity;
    if (quantity === null) {
      this.layer = null;
      this.fleet.isDirty = true;
      return;
    }
    this.paint();
    void this.readFriction();
  }

  /** Another site has other ground and other missions. */
  changeSite(): void {
    this.#cells = [];
    this.#window = null;
    this.configurations = [];
    this.configuration = null;
    this.layer = null;
    this.inspected = null;
    this.close();
    if (this.compare.isOn) void this.compare.read();
    if (this.quantity !== null) void this.readFriction();
  }

  /** The map shows this now: what is not read of it yet is read. */
  lookAt(seen: Bounds): void {
    this.#seen = seen;
    if (this.quantity === null || !this.#window) return;
    if (serves(this.#window, seen, this.fleet.cellM, SQUARES_MAX)) return;
    clearTimeout(this.#due);
    this.#due = setTimeout(() => void this.readFriction(), MOVED_MS);
  }

  async readFriction(): Promise<void> {
    const { site } = this.fleet;
    if (!site || document.hidden || this.quantity === null) return;
    if (this.isReading) {
      this.#readAgain = true;
      return;
    }
    this.isReading = true;
    const { at_ms } = this.time;
    try {
      const part = this.#seen && windowOn(this.#seen, this.fleet.cellM, SQUARES_MAX);
      const query = part ? queryOf(part) : new URLSearchParams();
      if (at_ms !== null) query.set('as_of', new Date(at_ms).toISOString());
      const read = await list<CellFriction>(`/v1/sites/${site}/friction/cells?${query}`, CELLS_MAX);
      // The site may have been changed meanwhile; the next look is for that one.
      if (site === this.fleet.site) this.#take(read, part);
      else this.#readAgain = true;
    } catch (error) {
      this.frictionProblem = saidOf(error);
    }
    this.isReading = false;
    if (!this.#readAgain) return;
    this.#readAgain = false;
    await this.readFriction();
  }

  #take(read: Listed<CellFriction>, part: Window | null): void {
    this.#cells = read.items;
    this.#window = part;
    this.isWhole = read.isWhole;
    this.time.stated = read.asOf;
    // What lies beside may have been measured by other models.
    const found = read.items.map((cell) => cell.configuration);
    this.configurations = [...new Set([...this.configurations, ...found])].sort();
    if (!this.configuration || !this.configurations.includes(this.configuration)) {
      this.configuration = this.configurations[0] ?? null;
    }
    this.frictionProblem = null;
    this.paint();
  }

  paint(): void {
    if (this.quantity === null) return;
    const squareM = this.#window?.squareM ?? this.fleet.cellM;
    this.layer = new Layer(this.#cells, this.configuration, squareM, this.quantity);
    this.fleet.isDirty = true;
  }

  /** A robot model as its agents declare it; null as long as no robot of the site has it. */
  modelOf(configuration: string | null): RobotModel | null {
    return this.fleet.robots.find((view) => view.robot.configuration === configuration)?.robot.model ?? null;
  }

  /** The name of a robot model, from whichever robot has it. */
  modelName(configuration: string): string {
    const robot = this.fleet.robots.find((view) => view.robot.configuration === configuration)?.robot;
    return robot ? `${robot.model.name}, ${robot.model.tyres}` : configuration.slice(0, 8);
  }

  /** The same in a list of models, where there is little room. */
  modelLabel(configuration: string): string {
    return modelLabel(configuration, this.configurations, (one) => this.modelOf(one));
  }

  /** Opens a mission, unless another is opened or it is closed before the server has answered. */
  async open(mission: string): Promise<void> {
    const mine = (this.#asked += 1);
    try {
      const detail = await ask<MissionDetail>(`/v1/missions/${mission}`);
      // What a robot has refused may have no path at all.
      const path = `/v1/missions/${mission}/path`;
      const plan = detail.state === 'rejected' ? null : await ask<PlannedPath>(path).catch(() => null);
      if (mine !== this.#asked) return;
      this.detail = detail;
      this.plan = plan;
      this.detailProblem = null;
      // A time line that somebody looks at stays where it is.
      if (this.replay?.mission !== detail.id || !this.replay.track) {
        this.replay?.pause();
        this.replay = hasEnded(detail) ? new Replay(detail, plan, () => (this.fleet.isDirty = true)) : null;
      }
    } catch (error) {
      if (mine !== this.#asked) return;
      this.detailProblem = saidOf(error);
    }
    this.fleet.isDirty = true;
  }

  close(): void {
    this.#asked += 1;
    this.detail = null;
    this.plan = null;
    this.replay?.pause();
    this.replay = null;
    this.fleet.isDirty = true;
  }

  /** Shows a place of the site that is being opened. */
  showOnOpening(center: PointM): void {
    this.wantedPlace = { center, scale: PLACE_SCALE };
  }

  show(points: PointM[]): void {
    this.wanted = { points };
  }

  end(): void {
    clearTimeout(this.#due);
    clearTimeout(this.#changed);
    clearInterval(this.#timer);
    this.time.pause();
  }
}

function queryOf({ bounds, squareM }: Window): URLSearchParams {
  return new URLSearchParams({
    x_min_m: String(bounds.xMin),
    y_min_m: String(bounds.yMin),
    x_max_m: String(bounds.xMax),
    y_max_m: String(bounds.yMax),
    resolution_m: String(squareM),
  });
}

// The guide through the first steps: whether it is shown, and which of them the state of the fleet has done.
import { untrack } from 'svelte';
import type { CellFriction, Mission, PlannedPath, ServerStatus } from '../api/schema';
import { Problem, ask, list } from '../api/client';
import { around, doneOf, followed, measuredSince, nextOf, type Sent } from '../guide';
import type { PointM } from '../map/camera';
import type { Fleet } from './fleet.svelte';
import type { View } from './view.svelte';

/** `open` or `closed` by whoever looks. */
const GUIDE_KEY = 'tread-guide';
const SENT_KEY = 'tread-sent';
/** Time between two looks for the friction of a mission, milliseconds. */
const LOOK_MS = 2_000;
/** Cells along a path that are looked through. */
const CELLS_MAX = 5_000;
/** Looks in vain after which a mission counts as one that shows no friction: 40 s of driving. */
const LOOKS_MAX = 20;
/** Looks in vain after which that is said of a mission that has ended: its last values may be under way. */
const LAST_LOOKS = 2;

export class Guide {
  #kept = $state(localStorage.getItem(GUIDE_KEY));
  #sent = $state.raw<Sent | null>(sentBefore());
  /** Whether this browser had sent a mission when the page was opened. */
  readonly #hadSent = this.#sent !== null;
  /** Corners of the cells that were measured on the mission that was sent. */
  friction = $state.raw<PointM[]>([]);
  /** The path of that mission. */
  #path: PointM[] = [];
  /** How often nothing was found that was measured on it. */
  #looks = $state(0);
  #isLooking = false;
  /** Whether the server lets robots join; null until it has said so. */
  #canJoin = $state<boolean | null>(null);

  constructor(
    readonly fleet: Fleet,
    readonly view: View,
  ) {
    fleet.sent = (mission) => this.#take(mission);
  }

  /** Shown until it is closed to whoever has sent nothing yet, or has no robots. */
  get isShown(): boolean {
    if (this.#kept !== null) return this.#kept === 'open';
    return !this.#hadSent || (this.fleet.isRead && this.fleet.robots.length === 0);
  }

  set isShown(isShown: boolean) {
    this.#kept = isShown ? 'open' : 'closed';
    localStorage.setItem(GUIDE_KEY, this.#kept);
  }

  /** The mission that was sent from here, at this site. */
  readonly sent = $derived.by(() => {
    const sent = this.#sent?.site === this.fleet.site ? this.#sent : null;
    return followed(sent, sent ? this.fleet.missions.get(sent.id) : undefined);
  });

  /** Whether it has ended without having driven: another one is needed. */
  get hasFailed(): boolean {
    const mission = this.sent && this.fleet.missions.get(this.sent.id);
    return mission?.ended_at != null && mission.started_at == null;
  }

  /** Whether it has ended, or was driven for a while, and nothing was measured: another one may show friction. */
  get isUnmeasured(): boolean {
    const mission = this.sent && this.fleet.missions.get(this.sent.id);
    return this.done.mission && !this.done.friction && (this.#looks >= LOOKS_MAX || (mission?.ended_at != null && this.#looks >= LAST_LOOKS));
  }

  readonly done = $derived.by(() =>
    doneOf(
      this.fleet.robots.map((entry) => entry.robot),
      this.sent,
      this.friction,
    ),
  );
  readonly next = $derived(nextOf(this.done));

  /** Whether the commands for a robot to join would be refused, by a server without `[robots]`. */
  get isClosed(): boolean {
    return this.#canJoin === false;
  }

  /** Asks the server whether robots can join, as long as that is the next step and not known. */
  async examine(): Promise<void> {
    if (this.next !== 'robot' || this.#canJoin !== null) return;
    try {
      this.#canJoin = (await ask<ServerStatus>('/v1/server')).robots_can_join;
    } catch {
      // The server is lost, which is said elsewhere; the commands say themselves what is wrong.
    }
  }

  /** A value of its own: it stays the same while robots and missions change. */
  readonly #isMissing = $derived(this.isShown && this.done.mission && !this.done.friction);

  /** Looks for friction as long as that is what is missing; ends with what it gives back. */
  follow(): () => void {
    if (!this.#isMissing) return () => undefined;
    untrack(() => void this.#look());
    const timer = setInterval(() => void this.#look(), LOOK_MS);
    return () => clearInterval(timer);
  }

  /** Brings the mission onto the map, with all friction that was measured on it. */
  async show(): Promise<void> {
    const { view } = this;
    view.compare.end();
    view.time.seek(view.time.moments.length);
    view.choose('theta');
    await this.#look();
    view.show([...this.friction, ...this.#path]);
  }

  #take(mission: Mission): void {
    const { id, site, robot } = mission;
    this.#sent = { id, site, robot, started_at: mission.started_at ?? null };
    this.friction = [];
    this.#path = [];
    this.#looks = 0;
    localStorage.setItem(SENT_KEY, JSON.stringify(this.#sent));
    // Whoever begins with the guide has it until it is closed.
    if (this.#kept === null && this.isShown) this.isShown = true;
  }

  async #look(): Promise<void> {
    const { sent, fleet } = this;
    if (!sent?.started_at || this.#isLooking || document.hidden) return;
    this.#isLooking = true;
    try {
      const path = await pathOf(sent.id);
      const place = around(path, fleet.cellM);
      const query = new URLSearchParams();
      if (place) {
        query.set('x_min_m', String(place.xMin));
        query.set('y_min_m', String(place.yMin));
        query.set('x_max_m', String(place.xMax));
        query.set('y_max_m', String(place.yMax));
      }
      const cells = await list<CellFriction>(`/v1/sites/${sent.site}/friction/cells?${query}`, CELLS_MAX);
      const configuration = fleet.byId.get(sent.robot)?.robot.configuration;
      if (this.sent?.id !== sent.id) return;
      this.#path = path;
      this.friction = measuredSince(cells.items, sent.started_at, configuration);
      if (this.friction.length === 0) this.#looks += 1;
    } catch {
      // The server is lost, which is said elsewhere.
    } finally {
      this.#isLooking = false;
    }
  }
}

/** The path of a mission; empty where it cannot be planned any more, as after a change of the map. */
async function pathOf(mission: string): Promise<PointM[]> {
  try {
    return (await ask<PlannedPath>(`/v1/missions/${mission}/path`)).points;
  } catch (error) {
    if (error instanceof Problem && !error.isLost) return [];
    throw error;
  }
}

/** What this browser sent when it was here before. */
function sentBefore(): Sent | null {
  try {
    const kept = JSON.parse(localStorage.getItem(SENT_KEY) ?? 'null') as Partial<Sent> | null;
    const isWhole = typeof kept?.id === 'string' && typeof kept.site === 'string' && typeof kept.robot === 'string';
    return isWhole ? { id: '', site: '', robot: '', ...kept, started_at: null } : null;
  } catch {
    return null;
  }
}

// What is drawn at the moment and for which purpose; kept whatever happens to server or sign-in.
import type {
  Circle,
  CreateMission,
  Mission,
  Terrain,
  TerrainClass,
  Trajectory,
  TrajectoryCheck,
  Waypoints,
} from '../api/schema';
import { ask } from '../api/client';
import type { DraftState } from '../address';
import { Draft, RADIUS_MIN_M, type DraftKind } from '../map/draft';
import type { PointM } from '../map/camera';
import type { Shape } from '../map/shape';
import { plain } from '../format';
import type { Said } from '../message';
import { preferences } from '../preferences.svelte';
import { NO_FAULTS, type DraftField, type Faults } from '../refusal';
import { texts } from '../texts';
import { about, inUnit } from '../units';
import type { Fleet } from './fleet.svelte';
import { AreaChanged, TerrainChanged, createTerrain, replaceArea, replaceTerrain, type FenceSide } from './ground';
import { refusalIn, refusalText } from './refused';

/** Wait after a change before the dry run is asked for, milliseconds. */
const CHECK_WAIT_MS = 350;

export type Purpose =
  | { what: 'mission' }
  | { what: 'replace'; mission: Mission }
  | { what: 'terrain'; terrain: Terrain | null }
  /** An area of the geofence; the one that it replaces, or none for a new one. */
  | { what: 'fence'; side: FenceSide; old: PointM[] | null };

/** A speed where none is given, metres per second. */
const SPEED_DEFAULT_M_S = 0.5;

export class Editor {
  purpose = $state.raw<Purpose | null>(null);
  draft = $state.raw<Draft | null>(null);
  /** Grows with each change of the draft. */
  version = $state(0);

  robot = $state('');
  /** Robots that get the mission, if it is for several; the dry run is for `robot`. */
  robots = $state.raw<string[]>([]);
  speed_m_s = $state(SPEED_DEFAULT_M_S);
  turns = $state(1);
  clockwise = $state(false);
  excite = $state(false);
  priority = $state(0);
  startPolicy = $state<'append' | 'replace' | 'refuse'>('append');
  linkPolicy = $state<'continue' | 'stop_after'>('continue');

  terrainId = $state('');
  terrainName = $state('');
  terrainClass = $state<TerrainClass>('grass');
  terrainLayer = $state(0);

  check = $state.raw<TrajectoryCheck | null>(null);
  /** What went wrong with the dry run: what the server says against the path, or that it is lost. */
  #refused = $state.raw<unknown>(null);
  isChecking = $state(false);
  /** What went wrong when it was sent or saved. */
  #unsent = $state.raw<unknown>(null);
  isSending = $state(false);
  /** What was discarded last, in case that was not meant. */
  discarded = $state.raw<DraftState | null>(null);
  /** Said after a success. */
  said = $state<Said | null>(null);

  /** What was drawn of the other kind, in case that is wanted after all. */
  #other: Draft | null = null;
  #due: ReturnType<typeof setTimeout> | undefined;
  #asked = 0;
  /** Names what is sent, so that sending it twice makes one mission. */
  #key = '';

  constructor(readonly fleet: Fleet) {}

  /** Begins a mission that each of several robots gets. */
  beginMissions(robots: string[]): void {
    const [first] = robots;
    if (first === undefined) return;
    this.beginMission(first);
    if (robots.length > 1) this.robots = robots;
  }

  beginMission(robot: string): void {
    this.robot = robot;
    this.robots = [];
    this.#begin({ what: 'mission' }, new Draft('circle'));
  }

  beginReplace(mission: Mission): void {
    this.robot = mission.robot;
    this.robots = [];
    this.#begin({ what: 'replace', mission }, this.#asIn(mission.trajectory));
  }

  /** What a mission was asked for, to be changed; its speed, turns and direction come with it. */
  #asIn(trajectory: Trajectory): Draft {
    if ('waypoints' in trajectory) {
      this.speed_m_s = trajectory.waypoints.speed_m_s ?? this.speed_m_s;
      return new Draft('waypoints', trajectory.waypoints.points);
    }
    const { center, radius_m, speed_m_s, turns, direction } = trajectory.circle;
    const draft = new Draft('circle');
    draft.typeCircle(center, radius_m);
    this.speed_m_s = speed_m_s ?? this.speed_m_s;
    this.turns = turns ?? 1;
    this.clockwise = direction === 'clockwise';
    return draft;
  }

  beginTerrain(terrain: Terrain | null): void {
    this.terrainId = terrain?.id ?? '';
    this.terrainName = terrain?.name ?? '';
    this.terrainClass = terrain?.class ?? 'grass';
    this.terrainLayer = terrain?.layer ?? 0;
    this.#begin({ what: 'terrain', terrain }, new Draft('terrain', terrain?.polygon));
  }

  beginFence(side: FenceSide, old: PointM[] | null): void {
    this.#begin({ what: 'fence', side, old }, new Draft('terrain', old ?? []));
  }

  #begin(purpose: Purpose, draft: Draft): void {
    this.purpose = purpose;
    this.draft = draft;
    this.#other = null;
    this.said = null;
    this.discarded = null;
    this.changed();
  }

  setKind(kind: DraftKind): void {
    if (!this.draft || this.draft.kind === kind) return;
    const other = this.#other ?? new Draft(kind);
    this.#other = this.draft;
    this.draft = other;
    this.changed();
  }

  /** Why what was typed can be no mission, in one sentence, and where; null when it can. */
  get #flaw(): { said: string; faults: Faults } | null {
    const of = (field: DraftField, said: string) => ({ said, faults: { ...NO_FAULTS, field } });
    const wrong = this.draft?.flaw ?? null;
    if (wrong === 'center') return of('center', texts.draw.flaw.center);
    const { system } = preferences;
    if (wrong === 'radius') {
      const least = plain(inUnit('length', RADIUS_MIN_M));
      return of('radius', texts.draw.flaw.radius(texts.draw.lengths[system], least));
    }
    if (wrong !== null) {
      const point = this.draft?.points[wrong - 1];
      const [hasX, hasY] = [Number.isFinite(point?.x_m), Number.isFinite(point?.y_m)];
      const axis = hasX ? 'y_m' : hasY ? 'x_m' : null;
      return { said: texts.draw.flaw.point(wrong), faults: { points: [wrong], axis, field: null } };
    }
    if (this.draft?.kind === 'terrain') return null;
    if (!(this.speed_m_s > 0)) return of('speed', texts.draw.flaw.speed(texts.draw.speeds[system]));
    const model = this.fleet.byId.get(this.robot)?.robot.model;
    const top = model?.limits.linear_max_m_s ?? Infinity;
    if (this.speed_m_s > top) return of('speed', texts.draw.flaw.fast(this.fleet.nameOf(this.robot), about('speed', top)));
    if (this.draft?.kind === 'circle' && !(this.turns > 0)) return of('turns', texts.draw.flaw.turns);
    return Number.isInteger(this.priority) ? null : of('priority', texts.draw.flaw.priority);
  }

  /** What is wrong with what is drawn: what was typed, or what the server says of it. */
  get checkProblem(): string | null {
    void this.version;
    const flaw = this.draft && !this.draft.isEmpty ? this.#flaw : null;
    return flaw?.said ?? (this.#refused === null ? null : refusalText(this.#refused, this.#hasPoints, this.#shape));
  }

  /** Why it could not be sent or saved; null unless that was tried. */
  get sendProblem(): string | null {
    return this.#unsent === null ? null : refusalText(this.#unsent, this.#hasPoints, this.#shape);
  }

  /** Which points and which field of the draft are at fault, by what was typed or by what the server says. */
  readonly faults: Faults = $derived.by(() => {
    void this.version;
    if (!this.draft || this.draft.isEmpty) return NO_FAULTS;
    const refusal = (error: unknown) => refusalIn(error, this.#hasPoints, this.#shape);
    return this.#flaw?.faults ?? refusal(this.#refused) ?? refusal(this.#unsent) ?? NO_FAULTS;
  });

  /** Where the points at fault lie, as far as they are numbers. */
  get faultyPlaces(): PointM[] {
    const places = this.faults.points.flatMap((number) => this.draft?.points[number - 1] ?? []);
    return places.filter(({ x_m, y_m }) => Number.isFinite(x_m) && Number.isFinite(y_m));
  }

  get #hasPoints(): boolean {
    return this.draft?.kind !== 'circle';
  }

  get #shape(): Shape | null {
    const { draft } = this;
    return draft && draft.kind !== 'circle' ? { points: draft.points, isArea: draft.kind === 'terrain' } : null;
  }

  /** Why the area that is drawn cannot be saved, beside what is wrong with it; null when it can. */
  get whyNotSaved(): string | null {
    void this.version;
    const { why } = texts.terrains;
    if (this.isSending) return why.sending;
    if (this.#flaw) return null;
    return this.draft?.isWhole ? null : why.corners(this.draft?.points.length ?? 0);
  }

  /** Why the mission that is drawn cannot be sent, beside what is wrong with it; null when it can. */
  get whyNotSent(): string | null {
    void this.version;
    const { why } = texts.draw;
    const { draft } = this;
    if (this.isSending) return why.sending;
    if (!draft || draft.isEmpty) return draft?.kind === 'waypoints' ? why.waypoints(0) : why.circle;
    if (this.#flaw) return null;
    if (!draft.isWhole) return draft.kind === 'waypoints' ? why.waypoints(draft.points.length) : why.circle;
    if (!this.robot) return why.robot;
    if (this.isChecking) return why.checking;
    return this.check !== null || this.#refused !== null ? null : why.checking;
  }

  /** Whether sending it ends other missions of its robots. */
  get cancelsOthers(): boolean {
    if (this.purpose?.what !== 'mission' || this.startPolicy !== 'replace') return false;
    const robots = new Set([this.robot, ...this.robots]);
    return this.fleet.openMissions.some((mission) => robots.has(mission.robot));
  }

  /** Says that draft or form are no longer what they were. */
  changed(): void {
    this.version += 1;
    this.fleet.isDirty = true;
    this.#key = '';
    this.check = null;
    this.#refused = null;
    this.#unsent = null;
    this.#asked += 1;
    this.isChecking = false;
    clearTimeout(this.#due);
    const isMission = this.purpose?.what === 'mission' || this.purpose?.what === 'replace';
    if (isMission && this.draft?.isWhole && this.robot && !this.#flaw) {
      this.isChecking = true;
      this.#due = setTimeout(() => void this.#dryRun(), CHECK_WAIT_MS);
    }
  }

  /** Everything that makes up the draft, to be gone on with elsewhere or later; null without one. */
  get state(): DraftState | null {
    void this.version;
    const { purpose, draft } = this;
    if (!purpose || !draft) return null;
    const of = purpose.what === 'replace' ? purpose.mission.id : purpose.what === 'terrain' ? purpose.terrain?.id : '';
    return {
      what: purpose.what === 'fence' ? purpose.side : purpose.what,
      of: of ?? '',
      kind: draft.kind,
      center: draft.center && { ...draft.center },
      radius_m: draft.radius_m,
      points: draft.points.map((point) => ({ ...point })),
      old: purpose.what === 'fence' ? purpose.old : null,
      revision: purpose.what === 'terrain' ? (purpose.terrain?.revision ?? null) : null,
      robot: this.robot,
      robots: this.robots,
      speed_m_s: this.speed_m_s,
      turns: this.turns,
      clockwise: this.clockwise,
      excite: this.excite,
      priority: this.priority,
      start: this.startPolicy,
      link: this.linkPolicy,
      id: this.terrainId,
      name: this.terrainName,
      class: this.terrainClass,
      layer: this.terrainLayer,
    };
  }

  /** Goes on with a draft; false while the mission or terrain that it changes is not known. */
  goOnWith(state: DraftState): boolean {
    const purpose = this.#purposeOf(state);
    if (!purpose) return false;
    const isMission = purpose.what === 'mission' || purpose.what === 'replace';
    if (isMission !== (state.kind !== 'terrain')) return true;
    const draft = new Draft(state.kind, state.points);
    if (state.center) draft.typeCircle(state.center, state.radius_m);
    this.robot = state.robot;
    this.robots = state.robots;
    this.speed_m_s = state.speed_m_s;
    this.turns = state.turns;
    this.clockwise = state.clockwise;
    this.excite = state.excite;
    this.priority = state.priority;
    this.startPolicy = state.start;
    this.linkPolicy = state.link;
    this.terrainId = state.id;
    this.terrainName = state.name;
    this.terrainClass = state.class;
    this.terrainLayer = state.layer;
    this.#begin(purpose, draft);
    return true;
  }

  #purposeOf({ what, of, old, revision }: DraftState): Purpose | null {
    if (what === 'mission') return { what };
    if (what === 'keep_in' || what === 'keep_out') return { what: 'fence', side: what, old };
    if (what === 'replace') {
      const mission = this.fleet.missions.get(of);
      return mission ? { what, mission } : null;
    }
    if (of === '') return { what, terrain: null };
    const terrain = this.fleet.terrains.find((known) => known.id === of);
    // Also after a reload it is a change of what it was begun on.
    return terrain ? { what, terrain: { ...terrain, revision: revision ?? terrain.revision } } : null;
  }

  /** Ends a draft that was sent or saved. */
  finish(): void {
    this.discard();
    this.discarded = null;
  }

  discard(): void {
    this.discarded = this.draft && !this.draft.isEmpty ? this.state : null;
    clearTimeout(this.#due);
    this.purpose = null;
    this.draft = null;
    this.check = null;
    this.#refused = null;
    this.#unsent = null;
    this.fleet.isDirty = true;
  }

  get trajectory(): Trajectory | null {
    const { draft } = this;
    if (!draft?.isWhole) return null;
    const options = this.excite ? { options: { excitation: { depth_ratio: 0.5, period_s: 3 } } } : {};
    if (draft.kind === 'circle' && draft.center) {
      return {
        circle: {
          center: draft.center,
          radius_m: draft.radius_m,
          speed_m_s: this.speed_m_s,
          direction: this.clockwise ? 'clockwise' : 'counter_clockwise',
          turns: this.turns,
          ...options,
        },
      } as Trajectory;
    }
    return { waypoints: { points: draft.points, speed_m_s: this.speed_m_s, ...options } } as Trajectory;
  }

  async #dryRun(): Promise<void> {
    const { trajectory } = this;
    const site = this.fleet.site;
    if (!trajectory || !site) return;
    const mine = (this.#asked += 1);
    try {
      const check = await ask<TrajectoryCheck>('/v1/trajectories/check', {
        method: 'POST',
        body: {
          site,
          robot: this.robot,
          trajectory,
          // Planned from where the robot will be when this mission's turn comes.
          ...(this.purpose?.what === 'replace'
            ? { replaces: this.purpose.mission.id }
            : { priority: this.priority, start_policy: this.startPolicy }),
        },
      });
      if (mine === this.#asked) this.check = check;
    } catch (error) {
      if (mine === this.#asked) this.#refused = error;
    }
    if (mine === this.#asked) this.isChecking = false;
  }

  /** Sends a mission, or what replaces one; true when the server has it. */
  async sendMission(): Promise<boolean> {
    const { trajectory, purpose } = this;
    const site = this.fleet.site;
    if (!trajectory || !site || !purpose) return false;
    if (purpose.what !== 'mission' && purpose.what !== 'replace') return false;
    if (purpose.what === 'replace') {
      const replacement = this.#planned(trajectory, this.robot);
      return this.#send(`/v1/missions/${purpose.mission.id}/replace`, 'POST', { trajectory: replacement });
    }
    const body = this.missionFor(this.robot);
    if (!body) return false;
    this.#key ||= crypto.randomUUID();
    return this.#send('/v1/missions', 'POST', body, { 'idempotency-key': this.#key }, this.fleet.sent);
  }

  /** What is drawn as a mission of a robot; null while it is none. */
  missionFor(robot: string): CreateMission | null {
    const { trajectory } = this;
    const site = this.fleet.site;
    if (!trajectory || !site) return null;
    const link = this.linkPolicy === 'continue' ? 'continue' : { stop_after: { silence_s: 5 } };
    return {
      site,
      robot,
      trajectory: this.#planned(trajectory, robot),
      priority: this.priority,
      start_policy: this.startPolicy,
      link_policy: link,
    } as CreateMission;
  }

  /** The trajectory with the start of its dry run, so that the robot plans what was shown. */
  #planned(trajectory: Trajectory, robot: string): Trajectory {
    const { check } = this;
    if (!check || this.isChecking || robot !== this.robot || check.start_source === 'trajectory') {
      return trajectory;
    }
    const withStart = <T extends Circle | Waypoints>(of: T): T => ({
      ...of,
      options: { ...of.options, expected_start: check.start },
    });
    if ('circle' in trajectory) return { circle: withStart(trajectory.circle) };
    return { waypoints: withStart(trajectory.waypoints) };
  }

  async saveTerrain(): Promise<boolean> {
    const { purpose, draft } = this;
    if (purpose?.what !== 'terrain' || !draft || !this.fleet.site) return false;
    const shape = {
      class: this.terrainClass,
      layer: this.terrainLayer,
      name: this.terrainName || this.terrainId,
      polygon: draft.points,
    };
    const { terrain } = purpose;
    return this.#save(async () => {
      if (terrain) await replaceTerrain(this.fleet, terrain, shape);
      else await createTerrain(this.fleet, { id: this.terrainId, ...shape });
    });
  }

  /** The terrain that is drawn, as somebody else has changed it meanwhile; null unless saving it was refused for that. */
  get conflict(): Terrain | null {
    return this.#unsent instanceof TerrainChanged ? this.#unsent.present : null;
  }

  /** Gives up what was drawn for what somebody else has saved. */
  loadPresent(): void {
    if (this.conflict) this.beginTerrain(this.conflict);
  }

  /** Saves what was drawn over what somebody else has saved. */
  async saveOver(): Promise<void> {
    if (!this.conflict) return;
    this.purpose = { what: 'terrain', terrain: this.conflict };
    if (await this.saveTerrain()) this.finish();
  }

  /** Saves the area that is drawn, in the place of the one that it changes. */
  async saveFence(): Promise<boolean> {
    const { purpose, draft } = this;
    if (purpose?.what !== 'fence' || !draft) return false;
    const { side, old } = purpose;
    const isSaved = await this.#save(() => replaceArea(this.fleet, { side, old, area: draft.points }));
    // Saved again, it is an area of its own.
    if (this.#unsent instanceof AreaChanged) this.purpose = { what: 'fence', side, old: null };
    return isSaved;
  }

  async #send(
    path: string,
    method: 'POST',
    body: unknown,
    headers: Record<string, string> = {},
    then: (answer: Mission) => void = () => undefined,
  ): Promise<boolean> {
    return this.#save(async () => then(await ask<Mission>(path, { method, body, headers })));
  }

  async #save(save: () => Promise<void>): Promise<boolean> {
    this.isSending = true;
    this.#unsent = null;
    try {
      await save();
      return true;
    } catch (error) {
      this.#unsent = error;
      return false;
    } finally {
      this.isSending = false;
    }
  }
}

// Everything that the page knows of one site, kept by the stream of events.
import { SvelteMap } from 'svelte/reactivity';
import type { Alert, DriveView, Geofence, Mission, MissionStep, Robot, Site, Terrain, TerrainFriction } from '../api/schema';
import { ask, list, saidOf } from '../api/client';
import type { Said } from '../message';
import { Stream, type Listener } from '../api/stream';
import { serverClock } from '../server_clock';
import { signedIn } from './session.svelte';
import { nameRanks, type NameRanks } from '../roster';
import { doing } from '../standstill';
import { texts } from '../texts';
import { Pace, remainingS, startsInS } from '../eta';
import { LatePlans } from './late_plans';
import { SiteAlerts } from './site_alerts.svelte';
import { Stops } from './stops.svelte';
import { Tracked } from './tracked';

/** Time between two changes of the lists on the page, milliseconds; the map does not wait. */
const LISTS_MS = 200;
/** Terrains and sites that are read at most. */
const LIST_MAX = 5_000;
/** Ended missions that are kept for the history. */
const ENDED_MAX = 1_000;
/** Time between two looks at terrains and fences, which no event tells of, milliseconds. */
const GROUND_MS = 10_000;
/** Robots of which every sample is kept for their curves; of more than these one in a while is. */
const CURVES_MAX = 50;
/** Time between two samples that are kept of large fleets, milliseconds. */
const SPARSE_MS = 1_000;
/** Time between two looks at which sites there are, milliseconds. */
const SITES_MS = 60_000;
const SITE_KEY = 'tread-site';

const byId = new Intl.Collator('en', { numeric: true });

/** A robot as lists show it. */
export interface RobotView {
  id: string;
  robot: Robot;
  receivedAt: number;
}

const TERMINAL = new Set(['succeeded', 'failed', 'cancelled', 'rejected', 'expired']);

export function hasEnded(mission: Mission): boolean {
  return TERMINAL.has(mission.state);
}

export class Fleet implements Listener {
  sites = $state.raw<Site[]>([]);
  site = $state<string | null>(null);
  isLive = $state(false);
  /** When the stream was lost, by the server's time; null while it lives or was never there. */
  lostAt = $state<number | null>(null);
  problem = $state<Said | null>(null);
  /** A monotonic clock for ages, milliseconds, twice a second. */
  now = $state(performance.now());
  selected = $state<string | null>(null);
  /** The site that is to be shown first, if it is one. */
  wantedSite: string | null = null;

  robots = $state.raw<RobotView[]>([]);
  readonly byId = $derived(new Map(this.robots.map((entry) => [entry.id, entry])));
  terrains = $state.raw<Terrain[]>([]);
  terrainFriction = $state.raw<TerrainFriction[]>([]);
  fence = $state.raw<Geofence | null>(null);
  readonly missions = new SvelteMap<string, Mission>();
  /** Alerts of this site and about the server that stand. */
  readonly alerts = new SvelteMap<string, Alert>();
  readonly siteAlerts = new SiteAlerts(
    (alert) => {
      // Those of the site that is shown come by its own stream too.
      if (alert.site !== this.site) this.raised(alert);
    },
    () => this.signedOut(),
  );
  readonly stops = new Stops(
    () => this.site,
    (robot) => this.nameOf(robot),
  );
  readonly #pace = new Pace();
  readonly #latePlans = new LatePlans(
    (id) => this.missions.get(id),
    (mission) => this.mission(mission),
  );

  /** For the map, which draws it afresh each time: not reactive. */
  readonly tracked = new Map<string, Tracked>();
  /** Asks the map for a frame: a robot moves, or something else looks different. */
  wake: () => void = () => undefined;
  /** Says that the friction map has changed somewhere. */
  mapChanged: () => void = () => undefined;
  /** Says that an alert was raised since the site was opened. */
  raised: (alert: Alert) => void = () => undefined;
  /** Says that a mission was sent from this page. */
  sent: (mission: Mission) => void = () => undefined;
  #isDirty = true;
  /** Steps of missions, for whoever shows a history. */
  lastStep = $state.raw<MissionStep | null>(null);

  #stream: Stream | null = null;
  #timers: ReturnType<typeof setInterval>[] = [];
  #listsDue: ReturnType<typeof setTimeout> | undefined;
  #seen: Set<string> | null = null;
  /** Grows with each change of the ground from this page. */
  #groundChanges = 0;
  /** Robots in the order of lists; null once another one is there, or one is gone. */
  #order: string[] | null = null;
  #namesAreOld = true;
  /** The order of robots by their names. */
  nameRanks = $state.raw<NameRanks>(new Map());
  /** Names that several robots of the site have. */
  #sameNames = $state.raw<ReadonlySet<string>>(new Set());
  /** Everything of this site was read once: what comes now is new. */
  isRead = $state(false);

  readonly openMissions = $derived(
    [...this.missions.values()]
      .filter((mission) => !hasEnded(mission))
      .sort((a, b) => rank(a) - rank(b) || b.priority - a.priority || (a.id < b.id ? -1 : 1)),
  );
  readonly endedMissions = $derived(
    [...this.missions.values()].filter(hasEnded).sort((a, b) => ((a.ended_at ?? '') < (b.ended_at ?? '') ? 1 : -1)),
  );
  readonly standingAlerts = $derived(newestFirst(this.alerts.values()));
  /** Those of the other sites too. */
  readonly allStandingAlerts = $derived(
    newestFirst([...this.alerts.values(), ...[...this.siteAlerts.standing.values()].filter(({ id }) => !this.alerts.has(id))]),
  );

  /** What stands about the server itself and stops its work. */
  get serverProblems(): Alert[] {
    return this.standingAlerts.filter((alert) => alert.robot === null && alert.severity === 'critical');
  }

  /** Set when something on the map may look different beside its robots. */
  get isDirty(): boolean {
    return this.#isDirty;
  }

  set isDirty(isDirty: boolean) {
    this.#isDirty = isDirty;
    if (isDirty) this.wake();
  }

  get selectedRobot(): Robot | null {
    return this.selected === null ? null : (this.byId.get(this.selected)?.robot ?? null);
  }

  /** The name of a robot of this site, with its identifier if another one has the same name. */
  nameOf(id: string): string {
    const name = this.byId.get(id)?.robot.name;
    if (name === undefined || name === id) return id;
    return this.#sameNames.has(name) ? `${name} (${id})` : name;
  }

  /** Whom or what an alert is about; robots of other sites are known by their identifiers. */
  subjectOf(alert: Alert): string {
    if (alert.robot == null) return texts.alerts.server;
    return alert.site === this.site ? this.nameOf(alert.robot) : alert.robot;
  }

  /** The name of a site. */
  siteName(id: string): string {
    return this.sites.find((site) => site.id === id)?.name ?? id;
  }

  /** How a robot is heard, as far as it is known: a lost server says nothing more of it. */
  linkOf(robot: Robot): { text: string; look: 'good' | 'warn' | 'bad' } {
    if (robot.link === 'offline') return { text: texts.link.offline, look: 'bad' };
    if (this.lostAt !== null) return { text: texts.robots.lastKnown, look: 'warn' };
    return { text: texts.link[robot.link], look: robot.link === 'online' ? 'good' : 'warn' };
  }

  /** The robot that can begin a mission soonest, as far as that shows; null without robots. */
  get readiest(): string | null {
    const rank = ({ robot }: RobotView) => {
      if (robot.link !== 'online' || !robot.live || robot.live.safety.stop) return 2;
      return robot.live.mode === 'idle' ? 0 : 1;
    };
    let best: RobotView | null = null;
    for (const entry of this.robots) if (!best || rank(entry) < rank(best)) best = entry;
    return best?.id ?? null;
  }

  /** Time until a mission ends, seconds; null where that cannot be known. */
  remainingS(mission: Mission): number | null {
    const entry = this.byId.get(mission.robot);
    if (!entry || this.lostAt !== null || this.stops.inForce.has(mission.robot)) return null;
    const state_age_ms = entry.robot.live?.state_age_ms ?? 0;
    const age_s = (state_age_ms + Math.max(0, this.now - entry.receivedAt)) / 1000;
    return remainingS(mission, entry.robot, age_s, this.#pace);
  }

  /** Time until a mission that waits begins, seconds; null where that cannot be known. */
  startsInS(mission: Mission): number | null {
    return startsInS(mission, this.openMissions, (other) => this.remainingS(other));
  }

  /** Robots of the site that are to stand and move. */
  readonly runaways = $derived(this.robots.map((entry) => entry.robot).filter((robot) => doing(robot.live).isBad));

  async start(): Promise<void> {
    this.#timers.push(setInterval(() => (this.now = performance.now()), 500));
    this.#timers.push(setInterval(() => void this.readGround(), GROUND_MS));
    this.#timers.push(setInterval(() => void this.readSites(), SITES_MS));
    await this.readSites();
  }

  async readSites(): Promise<void> {
    try {
      const sites = (await list<Site>('/v1/sites', LIST_MAX)).items;
      if (!signedIn.session) return;
      if (JSON.stringify(sites) !== JSON.stringify(this.sites)) this.sites = sites;
      this.problem = null;
      this.siteAlerts.follow(sites.length > 1);
    } catch (error) {
      this.problem = saidOf(error);
      return;
    }
    const kept = localStorage.getItem(SITE_KEY);
    const first = this.sites.find((site) => site.id === (this.wantedSite ?? kept)) ?? this.sites[0];
    this.wantedSite = null;
    if (first && !this.site) this.choose(first.id);
  }

  choose(site: string): void {
    this.#stream?.close();
    localStorage.setItem(SITE_KEY, site);
    this.site = site;
    this.selected = null;
    this.tracked.clear();
    this.#order = null;
    this.missions.clear();
    this.alerts.clear();
    this.robots = [];
    this.terrains = [];
    this.terrainFriction = [];
    this.fence = null;
    this.stops.forget();
    this.#pace.forget();
    this.isRead = false;
    this.isDirty = true;
    this.#stream = new Stream(`site=${encodeURIComponent(site)}`, this);
    void this.readGround();
    void this.stops.read();
  }

  end(): void {
    this.#stream?.close();
    this.#stream = null;
    this.siteAlerts.follow(false);
    for (const timer of this.#timers) clearInterval(timer);
    clearTimeout(this.#listsDue);
    this.#timers = [];
    this.stops.end();
  }

  /** Terrains, their friction and the geofence. */
  async readGround(): Promise<void> {
    const { site } = this;
    if (!site || document.hidden) return;
    const at = `/v1/sites/${site}`;
    const changes = this.#groundChanges;
    try {
      const [terrains, friction, fence] = await Promise.all([
        list<Terrain>(`${at}/terrains`, LIST_MAX),
        list<TerrainFriction>(`${at}/friction/terrains`, LIST_MAX),
        ask<Geofence>(`${at}/geofence`),
      ]);
      if (this.site !== site || changes !== this.#groundChanges) return;
      this.terrains = terrains.items;
      this.terrainFriction = friction.items;
      this.fence = fence;
      this.isDirty = true;
    } catch {
      // The stream says already that the server is lost.
    }
  }

  /** Takes a terrain that was saved or read by itself. */
  setTerrain(terrain: Terrain): void {
    const isKnown = this.terrains.some(({ id }) => id === terrain.id);
    this.terrains = isKnown ? this.terrains.map((known) => (known.id === terrain.id ? terrain : known)) : [...this.terrains, terrain];
    this.#groundChanged();
  }

  /** Takes the geofence that was saved. */
  setFence(fence: Geofence): void {
    this.fence = fence;
    this.#groundChanged();
  }

  /** What was asked for before is older. */
  #groundChanged(): void {
    this.#groundChanges += 1;
    this.isDirty = true;
    void this.readGround();
  }

  /** The site's square, metres. */
  get cellM(): number {
    return this.sites.find((site) => site.id === this.site)?.grid.cell_m ?? 1;
  }

  // The stream's part.

  begin(): void {
    this.#seen = new Set();
  }

  whole(): void {
    const seen = this.#seen;
    if (!seen) return;
    for (const id of this.tracked.keys()) if (!seen.has(`r${id}`)) this.#forget(id);
    for (const id of this.missions.keys()) if (!seen.has(`m${id}`)) this.missions.delete(id);
    for (const id of this.alerts.keys()) if (!seen.has(`a${id}`)) this.alerts.delete(id);
    this.#seen = null;
    this.isRead = true;
    this.isDirty = true;
    // Whoever has just signed in waits for it.
    this.#listNow();
    void this.stops.read();
    void this.readGround();
  }

  robot(robot: Robot): void {
    this.#seen?.add(`r${robot.id}`);
    const now = performance.now();
    const known = this.tracked.get(robot.id);
    // Of a robot that stands and says nothing new no frame is drawn.
    let looksNew = true;
    this.#namesAreOld ||= known?.robot.name !== robot.name;
    if (robot.retired_at) this.#forget(robot.id);
    else if (known) looksNew = known.update(robot, now, this.tracked.size > CURVES_MAX ? SPARSE_MS : 0);
    else {
      this.tracked.set(robot.id, new Tracked(robot, now));
      this.#order = null;
    }
    this.#pace.note(robot.id, robot.live?.mission, now - (robot.live?.state_age_ms ?? 0));
    this.stops.heard(robot);
    if (looksNew) this.wake();
    this.#listsSoon();
  }

  /** The drive socket says where its robot is. */
  driven(robot: string, view: DriveView): void {
    if (this.tracked.get(robot)?.seen(view, performance.now())) this.wake();
  }

  mission(mission: Mission): void {
    this.#seen?.add(`m${mission.id}`);
    this.missions.set(mission.id, mission);
    this.#latePlans.look(mission);
    this.isDirty = true;
    if (this.missions.size > ENDED_MAX * 2) {
      for (const old of this.endedMissions.slice(ENDED_MAX)) this.missions.delete(old.id);
    }
  }

  step(step: MissionStep): void {
    this.lastStep = step;
  }

  alert(alert: Alert): void {
    this.#seen?.add(`a${alert.id}`);
    this.siteAlerts.changed(alert);
    // This page may have changed one of another site.
    if (alert.site != null && alert.site !== this.site) return;
    if (this.isRead && !this.alerts.has(alert.id) && !alert.cleared_at && !alert.acknowledged_at) this.raised(alert);
    if (alert.cleared_at) this.alerts.delete(alert.id);
    else this.alerts.set(alert.id, alert);
    if (alert.code.startsWith('stop')) void this.stops.read();
  }

  map(): void {
    this.mapChanged();
  }

  link(isLive: boolean): void {
    if (isLive === this.isLive) return;
    this.isLive = isLive;
    this.lostAt = isLive ? null : serverClock.now();
    this.isDirty = true;
    if (isLive && this.sites.length === 0) void this.readSites();
  }

  signedOut(): void {
    signedIn.end();
  }

  #listsSoon(): void {
    this.#listsDue ??= setTimeout(() => this.#listNow(), LISTS_MS);
  }

  #listNow(): void {
    clearTimeout(this.#listsDue);
    this.#listsDue = undefined;
    this.#order ??= [...this.tracked.keys()].sort(byId.compare);
    this.robots = this.#order.flatMap((id) => {
      const tracked = this.tracked.get(id);
      return tracked ? { id, robot: tracked.robot, receivedAt: tracked.receivedAt } : [];
    });
    if (this.#namesAreOld) this.#readNames();
  }

  #readNames(): void {
    const robots = this.robots.map((entry) => entry.robot);
    this.nameRanks = nameRanks(robots);
    this.#sameNames = repeated(robots.map((robot) => robot.name));
    this.#namesAreOld = false;
  }

  #forget(id: string): void {
    if (!this.tracked.delete(id)) return;
    this.#order = null;
    this.#namesAreOld = true;
  }
}

/** What is there more than once. */
function repeated(names: readonly string[]): ReadonlySet<string> {
  const seen = new Set<string>();
  return new Set(names.filter((name) => seen.size === seen.add(name).size));
}

function newestFirst(alerts: Iterable<Alert>): Alert[] {
  return [...alerts].filter((alert) => !alert.cleared_at).sort((a, b) => (a.raised_at < b.raised_at ? 1 : -1));
}

/** Active missions before those that wait. */
function rank(mission: Mission): number {
  return mission.state === 'queued' ? 1 : 0;
}

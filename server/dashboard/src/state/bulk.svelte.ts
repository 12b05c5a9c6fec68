// What is done to several robots at once, with one line of what became of it for each.
import type { Mission, Stop } from '../api/schema';
import { Failure, ask, saidOf } from '../api/client';
import type { Said } from '../message';
import { stopState, stopWord } from '../standstill';
import { texts } from '../texts';
import { hasEnded, type Fleet } from './fleet.svelte';

/** Robots that are asked for at the same time; a browser has six connections to a server. */
const AT_ONCE = 5;
/** Time between two changes of the lines on the page, milliseconds. */
const SHOW_MS = 150;

export type Deed = 'stop' | 'clear' | 'pause' | 'resume' | 'cancel' | 'send';
/** Its turn comes, the robot has not confirmed it yet, done, with nothing to do, or failed. */
export type Outcome = 'waiting' | 'unconfirmed' | 'done' | 'nothing' | 'failed';

export interface Line {
  robot: string;
  outcome: Outcome;
  text: Said;
}

/** What became of one robot. */
interface Became {
  outcome: 'done' | 'nothing' | 'unconfirmed';
  text: Said;
}

const done = (text: Said): Became => ({ outcome: 'done', text });
const nothing = (text: Said): Became => ({ outcome: 'nothing', text });

export class Bulk {
  deed = $state<Deed | null>(null);
  /** What became of each robot when it was its turn. */
  #noted = $state.raw<Line[]>([]);
  isRunning = $state(false);

  /** Counts what was begun or ended early. */
  #run = 0;
  /** Whose lines are shown. */
  #shown = 0;

  constructor(readonly fleet: Fleet) {}

  /** What became of each robot, as it is now: stops are confirmed later than they are sent. */
  readonly lines = $derived.by(() => {
    const { byId, stops } = this.fleet;
    return this.#noted.map((line) => {
      if (line.outcome !== 'unconfirmed') return line;
      const stop = stops.inForce.get(line.robot);
      // One that is no longer in force was confirmed and cleared.
      if (!stop) return { ...line, outcome: 'done' as const, text: () => texts.bulk.cleared };
      const state = stopState(stop, byId.get(line.robot)?.robot.live);
      return state === 'unconfirmed' ? line : { ...line, outcome: 'done' as const, text: () => stopWord(state) };
    });
  });

  readonly counts = $derived.by(() => {
    const counts: Record<Outcome, number> = { waiting: 0, unconfirmed: 0, done: 0, nothing: 0, failed: 0 };
    for (const line of this.lines) counts[line.outcome] += 1;
    return counts;
  });

  /** Robots of which it failed. */
  get failed(): string[] {
    return this.lines.filter((line) => line.outcome === 'failed').map((line) => line.robot);
  }

  /** Nothing that moves robots is sent any more; what is under way ends. */
  abort(): void {
    if (this.isRunning && this.deed !== 'stop') this.#run += 1;
  }

  dismiss(): void {
    if (this.isRunning) return;
    this.deed = null;
    this.#noted = [];
  }

  async stop(ids: string[]): Promise<void> {
    const { fleet } = this;
    // Those that answer are not to wait for those that cannot.
    const isHeard = (id: string) => (fleet.byId.get(id)?.robot.link === 'online' ? 0 : 1);
    const order = [...ids].sort((a, b) => isHeard(a) - isHeard(b));
    // One request stops a whole site.
    const isWhole = ids.length > 1 && ids.length === fleet.robots.length;
    const all = isWhole ? fleet.stops.stopAll() : null;
    await this.#each('stop', order, async (id) => {
      const problem = await (all ?? fleet.stops.stop(id));
      if (problem !== null) throw new Failure(problem);
      const stop = fleet.stops.inForce.get(id);
      if (!stop) throw new Failure(() => texts.bulk.notAmong);
      return { outcome: 'unconfirmed', text: () => texts.bulk.unconfirmed };
    });
  }

  async clear(ids: string[]): Promise<void> {
    const { stops } = this.fleet;
    await this.#each('clear', ids, async (id) => {
      const stop: Stop | undefined = stops.inForce.get(id);
      if (!stop) return nothing(() => texts.bulk.notStopped);
      if (!stop.confirmed_at) throw new Failure(() => texts.bulk.notConfirmed);
      const problem = await stops.clear(stop);
      if (problem !== null) throw new Failure(problem);
      return done(() => texts.bulk.cleared);
    });
  }

  async pause(ids: string[]): Promise<void> {
    await this.#missions('pause', ids, (mission) => {
      const isDriving = mission.state === 'active' || mission.state === 'offered';
      return isDriving && !mission.pause_requested;
    });
  }

  async resume(ids: string[]): Promise<void> {
    await this.#missions('resume', ids, (mission) => mission.pause_requested);
  }

  async cancel(ids: string[]): Promise<void> {
    await this.#missions('cancel', ids, (mission) => mission.state !== 'cancelling');
  }

  /** Sends each robot the mission that `body` gives for it. */
  async send(ids: string[], body: (robot: string) => unknown): Promise<void> {
    await this.#each('send', ids, async (id) => {
      const headers = { 'idempotency-key': crypto.randomUUID() };
      this.fleet.sent(await ask<Mission>('/v1/missions', { method: 'POST', body: body(id), headers }));
      return done(() => texts.bulk.sent);
    });
  }

  async #missions(verb: 'pause' | 'resume' | 'cancel', ids: string[], isMeant: (mission: Mission) => boolean) {
    const meant = new Map<string, Mission[]>();
    for (const mission of this.fleet.missions.values()) {
      if (hasEnded(mission) || !isMeant(mission)) continue;
      meant.set(mission.robot, [...(meant.get(mission.robot) ?? []), mission]);
    }
    await this.#each(verb, ids, async (id) => {
      const missions = meant.get(id) ?? [];
      for (const mission of missions) await ask(`/v1/missions/${mission.id}/${verb}`, { method: 'POST' });
      return missions.length > 0 ? done(() => texts.bulk[verb](missions.length)) : nothing(() => texts.bulk.noMission[verb]);
    });
  }

  /** Does something for each robot, a few at a time, and says of each what became of it. */
  async #each(deed: Deed, ids: string[], act: (id: string) => Promise<Became>): Promise<void> {
    const mine = (this.#run += 1);
    this.#shown = mine;
    const lines = new Map<string, Line>(ids.map((robot) => [robot, { robot, outcome: 'waiting', text: () => texts.bulk.waiting }]));
    const show = () => {
      this.#noted = [...lines.values()];
    };
    this.deed = deed;
    this.isRunning = true;
    show();
    let shownAt = performance.now();
    const left = [...ids];
    const work = async () => {
      for (let id = left.shift(); id !== undefined; id = left.shift()) {
        let line: Line;
        // A stop is for all of its robots, whatever is done meanwhile.
        if (mine === this.#run || deed === 'stop') {
          try {
            line = { robot: id, ...(await act(id)) };
          } catch (error) {
            line = { robot: id, outcome: 'failed', text: saidOf(error) };
          }
        } else line = { robot: id, outcome: 'failed', text: () => texts.bulk.aborted };
        lines.set(id, line);
        // Another deed has the lines now.
        if (this.#shown !== mine || performance.now() - shownAt < SHOW_MS) continue;
        shownAt = performance.now();
        show();
      }
    };
    await Promise.all(Array.from({ length: AT_ONCE }, work));
    if (this.#shown !== mine) return;
    show();
    this.isRunning = false;
  }
}

/** What failed first, then what had nothing to do, then what is done. */
export function failuresFirst(lines: readonly Line[]): Line[] {
  const rank: Record<Outcome, number> = { failed: 0, unconfirmed: 1, waiting: 2, nothing: 3, done: 4 };
  return [...lines].sort((a, b) => rank[a.outcome] - rank[b.outcome]);
}


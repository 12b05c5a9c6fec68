// Stops: sent at once, shown until the robot has confirmed, cleared by name.
import { SvelteMap } from 'svelte/reactivity';
import type { FleetStop, Robot, Stop } from '../api/schema';
import { Problem, ask, list, saidOf, sentence } from '../api/client';
import type { Said } from '../message';
import { texts } from '../texts';

/** How often stops are read while one is unconfirmed, milliseconds. */
const READ_AGAIN_MS = 1_000;
/** Stops in force that are read at most. */
const STOPS_MAX = 10_000;
/** How long the server may take for a stop; it answers after 300 ms at most, milliseconds. */
const STOP_MAX_MS = 3_000;
/** The name of a stop of the whole fleet that is under way. */
export const FLEET = '*';

/** Where a stop that this page sent stands until it is among the stops of the server. */
export type Sent = { state: 'sending' } | { state: 'failed'; text: Said };
/** What is wrong with the stop of a robot. */
export type StopProblem = 'unconfirmed' | 'failed';

export class Stops {
  /** Stops in force by robot, the newest of each. */
  readonly inForce = new SvelteMap<string, Stop>();
  /** What was sent from here and not answered yet, or in vain, by robot. */
  readonly sent = new SvelteMap<string, Sent>();
  /** Why a clear did not come about, by robot. */
  readonly clearProblems = new SvelteMap<string, Said>();

  /** What is wrong with stops, by robot. */
  readonly #problems = $derived.by(() => {
    const problems = new Map<string, StopProblem>();
    for (const [robot, sent] of this.sent) if (sent.state === 'failed') problems.set(robot, 'failed');
    for (const stop of this.inForce.values()) if (!stop.confirmed_at) problems.set(stop.robot, 'unconfirmed');
    return problems;
  });

  #latches = new Map<string, string | null>();
  #again: ReturnType<typeof setTimeout> | undefined;
  #reading = false;
  #readAgain = false;

  constructor(
    readonly site: () => string | null,
    /** What people call a robot. */
    readonly nameOf: (robot: string) => string,
  ) {}

  /** What is wrong with the stop of a robot; null if nothing is, or it has none. */
  problemOf(robot: string): StopProblem | null {
    // A stop of all robots that failed has failed for each that has no other one.
    return this.#problems.get(robot) ?? (this.#problems.has(FLEET) && !this.inForce.has(robot) ? 'failed' : null);
  }

  /** Stops a robot; why it may not have got it, if so. */
  async stop(robot: string): Promise<Said | null> {
    this.sent.set(robot, { state: 'sending' });
    try {
      const stop = await ask<Stop>(`/v1/sites/${this.site()}/robots/${robot}/stop`, {
        method: 'POST',
        body: { reason: 'stopped on the page' },
        timeoutMs: STOP_MAX_MS,
      });
      this.#take([stop]);
      this.sent.delete(robot);
      return null;
    } catch (error) {
      const text = () => failureText(this.nameOf(robot), error);
      this.sent.set(robot, { state: 'failed', text });
      return text;
    }
  }

  /** Stops all robots of the site; why not, if so. */
  async stopAll(): Promise<Said | null> {
    this.sent.set(FLEET, { state: 'sending' });
    try {
      const stopped = await ask<FleetStop>('/v1/stop', {
        method: 'POST',
        body: { reason: 'all stopped on the page', site: this.site() },
        timeoutMs: STOP_MAX_MS,
      });
      this.#take(stopped.stops);
      this.sent.delete(FLEET);
      return null;
    } catch (error) {
      const text = () => failureText(texts.stop.everyRobot, error);
      this.sent.set(FLEET, { state: 'failed', text });
      return text;
    }
  }

  /** Clears a stop; why not, if so. */
  async clear(stop: Stop): Promise<Said | null> {
    this.clearProblems.delete(stop.robot);
    try {
      await ask<Stop>(`/v1/sites/${stop.site}/robots/${stop.robot}/stop/clear`, {
        method: 'POST',
        body: { stop: stop.id },
      });
      this.inForce.delete(stop.robot);
      return null;
    } catch (error) {
      const text = saidOf(error);
      this.clearProblems.set(stop.robot, text);
      return text;
    } finally {
      void this.read();
    }
  }

  /** What a robot says of its latch; a change is reason enough to ask the server. */
  heard(robot: Robot): void {
    const latch = robot.live?.safety.stop?.id ?? null;
    if (this.#latches.has(robot.id) && this.#latches.get(robot.id) === latch) return;
    const isNew = this.#latches.has(robot.id) || latch !== null;
    this.#latches.set(robot.id, latch);
    // A stop that the robot shows was heard after all.
    if (latch) this.sent.delete(robot.id);
    if (isNew) void this.read();
  }

  async read(): Promise<void> {
    const site = this.site();
    if (!site) return;
    if (this.#reading) {
      this.#readAgain = true;
      return;
    }
    this.#reading = true;
    clearTimeout(this.#again);
    try {
      const stops = await list<Stop>(`/v1/stops?site=${site}&in_force=true`, STOPS_MAX);
      if (site === this.site()) {
        const robots = new Set(stops.items.map((stop) => stop.robot));
        for (const robot of this.inForce.keys()) if (!robots.has(robot)) this.inForce.delete(robot);
        this.#take(stops.items);
      }
    } catch {
      // The stream says already that the server is lost; what is shown stays.
    }
    this.#reading = false;
    const isOpen = [...this.inForce.values()].some((stop) => !stop.confirmed_at);
    if (this.#readAgain || isOpen) {
      this.#again = setTimeout(() => void this.read(), this.#readAgain ? 0 : READ_AGAIN_MS);
    }
    this.#readAgain = false;
  }

  forget(): void {
    this.inForce.clear();
    this.sent.clear();
    this.clearProblems.clear();
    this.#latches.clear();
  }

  end(): void {
    clearTimeout(this.#again);
  }

  #take(stops: Stop[]): void {
    for (const stop of stops) {
      const known = this.inForce.get(stop.robot);
      if (stop.cleared_at) continue;
      // Identifiers sort by time.
      if (!known || known.id <= stop.id) this.inForce.set(stop.robot, stop);
      this.sent.delete(stop.robot);
    }
  }
}

function failureText(name: string, error: unknown): string {
  const isLost = error instanceof Problem && error.isLost;
  return isLost ? texts.stop.failed(name) : texts.stop.refused(name, sentence(error));
}

// When a mission ends, and when one that waits for it begins: about, and nothing where that cannot be known. Pure.
//
// The plan says how long the whole path takes if nothing slows the robot. What is left of the path is taken at a
// speed between the plan's mean speed v and the speed of the last two minutes: (v T + Δs) / (T + Δt), with
// the distance Δs that was driven in the time Δt. One corner hardly changes it; a robot that is held to half of
// its speed does.
import type { Mission, MissionProgress, Robot } from './api/schema';

/** Time in which the speed is observed, seconds. */
const WINDOW_S = 120;
/** Weight of the plan against what is observed, seconds. */
const PLAN_S = 20;
/** After so long, seconds, a robot that makes less than this share of the plan's speed is stuck: nobody knows. */
const STUCK_S = 10;
const STUCK_RATIO = 0.1;
/** States older than this say nothing of what is left, seconds. */
const OLD_S = 5;

interface Sample {
  at_ms: number;
  driven_m: number;
}

/** How fast missions get on: the distances of the last two minutes, of each robot's active mission. */
export class Pace {
  #runs = new Map<string, { mission: string; plan: string; samples: Sample[] }>();

  /** Takes what a robot says of its mission, null for none; when that was so, monotonic, milliseconds. */
  note(robot: string, progress: MissionProgress | null | undefined, at_ms: number): void {
    if (!progress || progress.paused || progress.paused_by) {
      // A pause says nothing of the speed.
      this.#runs.delete(robot);
      return;
    }
    let run = this.#runs.get(robot);
    const last = run?.samples.at(-1);
    const isOther = run?.mission !== progress.id || run.plan !== progress.plan_hash;
    if (!run || isOther || (last && progress.driven_m < last.driven_m)) {
      run = { mission: progress.id, plan: progress.plan_hash, samples: [] };
      this.#runs.set(robot, run);
    } else if (last && last.at_ms >= at_ms) return;
    run.samples.push({ at_ms, driven_m: progress.driven_m });
    // The one before the window stays, so that the window is whole.
    while ((run.samples[1]?.at_ms ?? Infinity) <= at_ms - WINDOW_S * 1000) run.samples.shift();
  }

  /** What was driven in the last two minutes of a robot's mission. */
  of(robot: string): { distance_m: number; time_s: number } {
    const samples = this.#runs.get(robot)?.samples ?? [];
    const [first, last] = [samples[0], samples.at(-1)];
    if (!first || !last) return { distance_m: 0, time_s: 0 };
    return { distance_m: last.driven_m - first.driven_m, time_s: (last.at_ms - first.at_ms) / 1000 };
  }

  forget(): void {
    this.#runs.clear();
  }
}

/** Time until a mission ends, seconds; null where that cannot be known. `age_s` is the age of what the robot says. */
export function remainingS(mission: Mission, robot: Robot | undefined, age_s: number, pace: Pace): number | null {
  const { plan } = mission;
  const live = robot?.live;
  const progress = live?.mission;
  if (mission.state !== 'active' || mission.pause_requested || mission.replacement || !plan) return null;
  if (!live || !progress || robot.link !== 'online' || age_s > OLD_S) return null;
  if (progress.id !== mission.id || progress.revision !== mission.revision) return null;
  if (live.mode !== 'tracking' || live.safety.stop || progress.paused || progress.paused_by) return null;
  if (!(plan.duration_s > 0) || !(progress.length_m > 0)) return null;
  const planned_m_s = progress.length_m / plan.duration_s;
  const { distance_m, time_s } = pace.of(robot.id);
  if (time_s >= STUCK_S && distance_m < STUCK_RATIO * planned_m_s * time_s) return null;
  const speed_m_s = (planned_m_s * PLAN_S + distance_m) / (PLAN_S + time_s);
  return Math.max(0, (progress.length_m - progress.driven_m) / speed_m_s - age_s);
}

/** Whether a mission of the same robot is driven before another one. */
function isBefore(a: Mission, b: Mission): boolean {
  if ((a.state === 'queued') !== (b.state === 'queued')) return a.state !== 'queued';
  return a.priority === b.priority ? a.id < b.id : a.priority > b.priority;
}

/**
 * Time until a mission that waits begins, seconds: the end of the one that is driven, and those between. Null where one
 * of them is not known.
 */
export function startsInS(mission: Mission, open: readonly Mission[], remaining: (mission: Mission) => number | null): number | null {
  if (mission.state !== 'queued' || mission.pause_requested) return null;
  const before = open.filter((other) => other.robot === mission.robot && other !== mission && isBefore(other, mission));
  // Why one waits for which no other is driven, nobody says.
  if (before.length === 0) return null;
  let total_s = 0;
  for (const other of before) {
    const lasts_s = other.state === 'queued' && !other.pause_requested ? other.plan?.duration_s : remaining(other);
    if (lasts_s === null || lasts_s === undefined) return null;
    total_s += lasts_s;
  }
  return total_s;
}

/** As exact as an estimate can be read: to 5 s, 10 s, a minute, 5 minutes. */
export function roughly(seconds: number): number {
  for (const [below, step] of [
    [57.5, 5],
    [595, 10],
    [3_570, 60],
  ] as const) {
    if (seconds < below) return Math.max(step, Math.round(seconds / step) * step);
  }
  return Math.round(seconds / 300) * 300;
}

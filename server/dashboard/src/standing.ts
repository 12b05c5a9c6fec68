// Whether a robot stands where it is to: commanded is one thing, measured another.

import type { RobotLive, Stop } from './api/schema';
import { texts } from './texts';

/** What a robot does; where it is stopped whether it stands, and in any case that it does not. */
export function doing(live: RobotLive | null | undefined): { text: string; isBad: boolean } {
  if (!live) return { text: texts.unknown, isBad: false };
  const standing = live.safety.standing?.state;
  if (standing === 'does_not_stand' || standing === 'moves') return { text: texts.standing[standing], isBad: true };
  const isStopped = live.mode === 'stopped' && (standing === 'stopping' || standing === 'standing');
  return { text: isStopped ? texts.standing[standing] : texts.mode[live.mode], isBad: false };
}

/** Whether a robot says that it is in fault. */
export function hasFault(live: RobotLive | null | undefined): boolean {
  return live != null && (live.mode === 'fault' || live.fault != null);
}

/** How a stop that is in force goes on, the worst first: not obeyed, not confirmed, coming to rest, at rest. */
export const STOP_STATES = ['runs', 'moves', 'unconfirmed', 'stopping', 'standing'] as const;
export type StopState = (typeof STOP_STATES)[number];

export function stopState(stop: Stop, live: RobotLive | null | undefined): StopState {
  const standing = live?.safety.standing?.state;
  if (!stop.confirmed_at) return 'unconfirmed';
  if (standing === 'does_not_stand') return 'runs';
  if (standing === 'moves') return 'moves';
  const stands = standing === 'standing' || (standing === undefined && stop.standing_at);
  return stands ? 'standing' : 'stopping';
}

/** Whether a stop is not what it is to be, which is shown in red. */
export function isRed(state: StopState): boolean {
  return state !== 'stopping' && state !== 'standing';
}

/** How the stop of a robot goes on, in a word, as {@link doing} says it of the robot. */
export function stopWord(state: StopState): string {
  const words = {
    runs: texts.standing.does_not_stand,
    moves: texts.standing.moves,
    unconfirmed: texts.stop.problems.unconfirmed,
    stopping: texts.standing.stopping,
    standing: texts.standing.standing,
  };
  return words[state];
}

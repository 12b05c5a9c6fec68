// Whether a robot that is commanded to rest is at standstill: commanded is one thing, measured another.

import type { RobotLive, Stop } from './api/schema';
import { texts } from './texts';

/** What a robot does; where it is stopped whether it stands, and in any case that it does not. */
export function doing(live: RobotLive | null | undefined): { text: string; isBad: boolean } {
  if (!live) return { text: texts.unknown, isBad: false };
  const state = live.safety.standstill?.state;
  if (state === 'standstill_not_reached' || state === 'unexpected_motion') return { text: texts.standstill[state], isBad: true };
  const isStopped = live.mode === 'stopped' && (state === 'stopping' || state === 'standstill');
  return { text: isStopped ? texts.standstill[state] : texts.mode[live.mode], isBad: false };
}

/** Whether a robot says that it is in fault. */
export function hasFault(live: RobotLive | null | undefined): boolean {
  return live != null && (live.mode === 'fault' || live.fault != null);
}

/** How a stop that is in force goes on, the worst first: not obeyed, not confirmed, coming to rest, at rest. */
export const STOP_STATES = ['runs', 'moves', 'unconfirmed', 'stopping', 'standstill'] as const;
export type StopState = (typeof STOP_STATES)[number];

export function stopState(stop: Stop, live: RobotLive | null | undefined): StopState {
  const state = live?.safety.standstill?.state;
  if (!stop.confirmed_at) return 'unconfirmed';
  if (state === 'standstill_not_reached') return 'runs';
  if (state === 'unexpected_motion') return 'moves';
  const stands = state === 'standstill' || (state === undefined && stop.standstill_at);
  return stands ? 'standstill' : 'stopping';
}

/** Whether a stop is not what it is to be, which is shown in red. */
export function isRed(state: StopState): boolean {
  return state !== 'stopping' && state !== 'standstill';
}

/** How the stop of a robot goes on, in a word, as {@link doing} says it of the robot. */
export function stopWord(state: StopState): string {
  const words = {
    runs: texts.standstill.standstill_not_reached,
    moves: texts.standstill.unexpected_motion,
    unconfirmed: texts.stop.problems.unconfirmed,
    stopping: texts.standstill.stopping,
    standstill: texts.standstill.standstill,
  };
  return words[state];
}

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

/** A stop that is in force: unconfirmed, stopping, standing, or not obeyed. */
export function stopped(stop: Stop, name: string, live: RobotLive | null | undefined): { text: string; look: 'held' | 'red' } {
  const standing = live?.safety.standing?.state;
  if (!stop.confirmed_at) return { text: texts.stop.unconfirmed(name), look: 'red' };
  if (standing === 'does_not_stand') return { text: texts.stop.runs(name), look: 'red' };
  if (standing === 'moves') return { text: texts.stop.moves(name), look: 'red' };
  const stands = standing === 'standing' || (standing === undefined && stop.standing_at);
  return { text: stands ? texts.stop.confirmed(name) : texts.stop.stopping(name), look: 'held' };
}

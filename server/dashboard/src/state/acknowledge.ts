// Acknowledges several alerts, a few at a time.
import type { Alert } from '../api/schema';
import { ask, saidOf } from '../api/client';
import type { Said } from '../message';

/** Alerts that are acknowledged at the same time; a browser has six connections to a server. */
const AT_ONCE = 4;

/** Acknowledges alerts and hands on what became of each; the first problem, if there was one. */
export async function acknowledgeAll(alerts: readonly Alert[], done: (alert: Alert) => void): Promise<Said | null> {
  const left = [...alerts];
  let problem: Said | null = null;
  const work = async () => {
    for (let alert = left.shift(); alert; alert = left.shift()) {
      try {
        done(await acknowledge(alert));
      } catch (error) {
        problem ??= saidOf(error);
      }
    }
  };
  await Promise.all(Array.from({ length: AT_ONCE }, work));
  return problem;
}

export function acknowledge({ id }: Alert): Promise<Alert> {
  return ask<Alert>(`/v1/alerts/${id}/acknowledge`, { method: 'POST' });
}

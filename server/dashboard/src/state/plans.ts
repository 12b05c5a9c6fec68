// The smooth paths of active missions, which the server plans on request. They change when their
// robot says from where it planned, and with the revision. Not reactive: the map draws them.
import type { Mission, PlannedPath } from '../api/schema';
import { ask } from '../api/client';
import { planned, type Planned } from '../map/approach';

/** Paths that are kept; planning costs the server time, and a map with more is read by nobody. */
const PATHS_MAX = 20;

export class Plans {
  readonly #paths = new Map<string, Planned | null>();

  constructor(readonly changed: () => void) {}

  /** The path of a mission, as soon as it is known. */
  of(mission: Mission): Planned | null {
    // Until its robot has said from where it comes, a circle is drawn exactly by what was asked for.
    if ('circle' in mission.trajectory && !mission.plan?.begin) return null;
    const key = keyOf(mission);
    const known = this.#paths.get(key);
    if (known !== undefined || this.#paths.size >= PATHS_MAX) return known ?? null;
    this.#paths.set(key, null);
    void ask<PlannedPath>(`/v1/missions/${mission.id}/path`).then(
      (path) => {
        this.#paths.set(key, planned(path, mission.trajectory, mission.plan?.begin ? mission.plan.length_m : undefined));
        this.changed();
      },
      // The straight lines between its points stay.
      () => undefined,
    );
    return null;
  }

  /** Forgets the paths of all other missions. */
  keep(missions: Mission[]): void {
    const kept = new Set(missions.map(keyOf));
    for (const key of this.#paths.keys()) if (!kept.has(key)) this.#paths.delete(key);
  }
}

function keyOf(mission: Mission): string {
  return JSON.stringify([mission.id, mission.revision, mission.plan?.begin]);
}

// A robot may begin to drive before the server has its plan, and no event tells of the plan then: such a
// mission is read again.
import type { Mission } from '../api/schema';
import { ask } from '../api/client';

/** Wait before a mission is read, which grows from try to try, milliseconds. */
const WAIT_MS = 600;
const TRIES_MAX = 5;

export class LatePlans {
  #tries = new Map<string, number>();

  constructor(
    readonly known: (id: string) => Mission | undefined,
    readonly take: (mission: Mission) => void,
  ) {}

  /** Reads the plan of a mission that is under way without one. */
  look({ id, state, plan }: Mission): void {
    const tried = this.#tries.get(id) ?? 0;
    if (plan || (state !== 'active' && state !== 'paused')) this.#tries.delete(id);
    else if (tried < TRIES_MAX) {
      this.#tries.set(id, tried + 1);
      setTimeout(() => void this.#read(id), WAIT_MS * (tried + 1));
    }
  }

  async #read(id: string): Promise<void> {
    const before = this.known(id);
    if (!before || before.plan) return;
    const read = await ask<Mission>(`/v1/missions/${id}`).catch(() => null);
    const now = this.known(id);
    if (!now || now.plan) return;
    const isSame = read?.revision === now.revision;
    if (read?.plan && isSame) this.take({ ...now, plan: read.plan });
    else this.look(now);
  }
}

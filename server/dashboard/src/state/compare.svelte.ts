// How the friction map differs between two times: which times, what the server says, and its layer.
import type { CellDifference } from '../api/schema';
import { list, sentence } from '../api/client';
import { Comparison } from '../map/compare';
import type { Fleet } from './fleet.svelte';

/** Entries that are read; the API gives them in pages of 1000. */
const CELLS_MAX = 20_000;
/** How far back the first time is at first, milliseconds. */
const BACK_MS = 3_600_000;

export class Compare {
  isOn = $state(false);
  /** Both as `<input type="datetime-local">` has them, in the time zone of whoever looks. */
  from = $state('');
  to = $state('');
  layer = $state.raw<Comparison | null>(null);
  problem = $state<string | null>(null);
  isReading = $state(false);
  isWhole = $state(true);
  /** The times that the server has rounded to, as it states them; the second is null for the present. */
  stated = $state.raw<{ from: string | null; to: string | null } | null>(null);

  #asked = 0;

  constructor(readonly fleet: Fleet) {}

  begin(): void {
    this.isOn = true;
    this.from ||= local(Date.now() - BACK_MS);
    void this.read();
  }

  /** Compares the present with a time that long ago. */
  since(ago_ms: number): void {
    this.from = local(Date.now() - ago_ms);
    this.to = '';
    void this.read();
  }

  end(): void {
    this.isOn = false;
    this.layer = null;
    this.#asked += 1;
    this.fleet.isDirty = true;
  }

  async read(): Promise<void> {
    const { site } = this.fleet;
    const from = Date.parse(this.from);
    const to = this.to ? Date.parse(this.to) : null;
    if (!site || Number.isNaN(from) || Number.isNaN(to)) return;
    const mine = (this.#asked += 1);
    this.isReading = true;
    const query = new URLSearchParams({ from: new Date(from).toISOString() });
    if (to !== null) query.set('to', new Date(to).toISOString());
    try {
      const read = await list<CellDifference>(`/v1/sites/${site}/friction/difference?${query}`, CELLS_MAX);
      if (mine !== this.#asked) return;
      this.layer = new Comparison(read.items, this.fleet.cellM);
      this.isWhole = read.isWhole;
      this.stated = { from: read.from, to: read.asOf };
      this.problem = null;
    } catch (error) {
      if (mine !== this.#asked) return;
      this.problem = sentence(error);
    }
    this.isReading = false;
    this.fleet.isDirty = true;
  }
}

/** A wall time as the input has it. */
export function local(atMs: number): string {
  const here = new Date(atMs - new Date(atMs).getTimezoneOffset() * 60_000);
  return here.toISOString().slice(0, 16);
}

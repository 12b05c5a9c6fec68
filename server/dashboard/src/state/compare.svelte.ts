// How the friction map differs between two times: which times, what the server says, and its layer.
import type { CellDifference } from '../api/schema';
import { list, saidOf } from '../api/client';
import type { Said } from '../message';
import { minute, momentOf } from '../format';
import { Comparison } from '../map/compare';
import { serverClock } from '../server_clock';
import { texts } from '../texts';
import type { Fleet } from './fleet.svelte';

/** Entries that are read; the API gives them in pages of 1000. */
const CELLS_MAX = 20_000;
/** How far back the first time is at first, milliseconds. */
const BACK_MS = 3_600_000;

export class Compare {
  isOn = $state(false);
  /** Both as they are typed, in the time zone of whoever looks; the second is empty for the present. */
  from = $state('');
  to = $state('');
  layer = $state.raw<Comparison | null>(null);
  problem = $state<Said | null>(null);
  isReading = $state(false);
  isWhole = $state(true);
  /** The times that the server has rounded to, as it states them; the second is null for the present. */
  stated = $state.raw<{ from: string | null; to: string | null } | null>(null);

  #asked = 0;

  constructor(readonly fleet: Fleet) {}

  /** The times that are typed; null while one of them cannot be read. */
  get times(): { from_ms: number; to_ms: number | null } | null {
    const [from_ms, to_ms] = [momentOf(this.from), this.to.trim() === '' ? null : momentOf(this.to)];
    if (Number.isNaN(from_ms) || (to_ms !== null && Number.isNaN(to_ms))) return null;
    return { from_ms, to_ms };
  }

  begin(): void {
    this.isOn = true;
    this.from ||= minute(serverClock.now() - BACK_MS);
    void this.read();
  }

  /** Takes these times, for instance those of an address; without reading. */
  bringBack({ from_ms, to_ms }: { from_ms: number; to_ms: number | null }): void {
    this.from = minute(from_ms);
    this.to = to_ms === null ? '' : minute(to_ms);
  }

  /** Compares the present with a time that long ago. */
  since(ago_ms: number): void {
    this.from = minute(serverClock.now() - ago_ms);
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
    const { times } = this;
    if (!site) return;
    const mine = (this.#asked += 1);
    if (!times) {
      const field = Number.isNaN(momentOf(this.from)) ? 'from' : 'to';
      const example = minute(serverClock.now() - BACK_MS);
      this.problem = () => texts.map.momentWrong(texts.map[field], example);
      this.isReading = false;
      return;
    }
    this.isReading = true;
    const query = new URLSearchParams({ from: new Date(times.from_ms).toISOString() });
    if (times.to_ms !== null) query.set('to', new Date(times.to_ms).toISOString());
    try {
      const read = await list<CellDifference>(`/v1/sites/${site}/friction/difference?${query}`, CELLS_MAX);
      if (mine !== this.#asked) return;
      this.layer = new Comparison(read.items, this.fleet.cellM);
      this.isWhole = read.isWhole;
      this.stated = { from: read.from, to: read.asOf };
      this.problem = null;
    } catch (error) {
      if (mine !== this.#asked) return;
      this.problem = saidOf(error);
    }
    this.isReading = false;
    this.fleet.isDirty = true;
  }
}

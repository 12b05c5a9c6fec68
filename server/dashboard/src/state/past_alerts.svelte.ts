// Alerts of the past, with those that stand: read from the server page by page, the newest first.
import { SvelteSet } from 'svelte/reactivity';
import type { Alert } from '../api/schema';
import { ask, saidOf } from '../api/client';
import type { Said } from '../message';

/** Alerts of one page. */
const PAGE = 50;

export interface AlertFilter {
  /** Each is empty for all. */
  kind: string;
  site: string;
  robot: string;
}

export class PastAlerts {
  items = $state.raw<Alert[]>([]);
  /** Kinds of all that was ever read. */
  readonly kinds = new SvelteSet<string>();
  problem = $state<Said | null>(null);
  isReading = $state(false);
  hasMore = $state(false);

  #cursor: string | null = null;
  #asked = 0;

  /** Reads the newest ones that pass a filter. */
  async read(filter: AlertFilter): Promise<void> {
    this.#cursor = null;
    await this.#page(filter, []);
  }

  /** Reads the page behind those that were read. */
  async more(filter: AlertFilter): Promise<void> {
    await this.#page(filter, this.items);
  }

  async #page({ kind, site, robot }: AlertFilter, before: Alert[]): Promise<void> {
    const mine = (this.#asked += 1);
    const query = new URLSearchParams({ limit: String(PAGE) });
    if (site) query.set('site', site);
    if (kind) query.set('kind', kind);
    if (robot) query.set('robot', robot);
    if (this.#cursor) query.set('cursor', this.#cursor);
    this.isReading = true;
    try {
      const page = await ask<{ items: Alert[]; next_cursor?: string | null }>(`/v1/alerts?${query}`);
      if (mine !== this.#asked) return;
      this.items = [...before, ...page.items];
      for (const { code } of page.items) this.kinds.add(code);
      this.#cursor = page.next_cursor ?? null;
      this.hasMore = this.#cursor !== null;
      this.problem = null;
    } catch (error) {
      if (mine !== this.#asked) return;
      this.problem = saidOf(error);
    }
    this.isReading = false;
  }
}

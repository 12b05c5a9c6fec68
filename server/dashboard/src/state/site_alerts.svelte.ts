// Alerts of all sites that whoever is signed in may see, beside those of the site that is shown: a stream of alerts
// alone. Opened only where there is more than one site.
import { SvelteMap } from 'svelte/reactivity';
import type { Alert } from '../api/schema';
import { Stream } from '../api/stream';

export class SiteAlerts {
  /** Alerts about sites that stand. */
  readonly standing = new SvelteMap<string, Alert>();

  #stream: Stream | null = null;
  #seen: Set<string> | null = null;
  /** Everything was read once: what comes now is new. */
  #isRead = false;

  constructor(
    /** Says that an alert was raised since the stream was opened. */
    readonly raised: (alert: Alert) => void,
    readonly signedOut: () => void,
  ) {}

  /** Follows all sites, or ends. */
  follow(isWanted: boolean): void {
    if (isWanted === (this.#stream !== null)) return;
    this.#stream?.close();
    this.#stream = null;
    this.standing.clear();
    this.#isRead = false;
    if (!isWanted) return;
    this.#stream = new Stream('topics=alerts', {
      begin: () => {
        this.#seen = new Set();
      },
      whole: () => {
        for (const id of this.standing.keys()) if (this.#seen?.has(id) === false) this.standing.delete(id);
        this.#seen = null;
        this.#isRead = true;
      },
      alert: (alert) => this.#take(alert),
      signedOut: this.signedOut,
    });
  }

  /** Takes what this page has changed of an alert. */
  changed(alert: Alert): void {
    if (this.standing.has(alert.id)) this.#take(alert);
  }

  #take(alert: Alert): void {
    this.#seen?.add(alert.id);
    if (alert.site == null) return;
    const isNew = this.#isRead && !this.standing.has(alert.id) && !alert.cleared_at && !alert.acknowledged_at;
    if (alert.cleared_at) this.standing.delete(alert.id);
    else this.standing.set(alert.id, alert);
    if (isNew) this.raised(alert);
  }
}

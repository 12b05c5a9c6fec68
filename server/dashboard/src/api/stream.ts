// The stream of events: opened, resumed by the browser, watched, opened again when it is lost.
import type { Alert, Event as Sent, MapChange, Mission, MissionStep, Robot } from './schema';
import { Problem, ask } from './client';

/** Silence after which the server is asked whether it is there, milliseconds. */
const SILENCE_MAX_MS = 3_000;
/** How often silence is looked at, milliseconds. */
const LOOK_MS = 500;
/** How long the server may take to say that it is there, milliseconds. */
const READY_MAX_MS = 2_000;
/** Wait before a lost stream is opened again, milliseconds. */
const AGAIN_MS = 1_000;

export interface Listener {
  begin(): void;
  whole(): void;
  robot(robot: Robot): void;
  mission(mission: Mission): void;
  step(step: MissionStep): void;
  alert(alert: Alert): void;
  /** The friction map has changed somewhere. */
  map(change: MapChange): void;
  /** The stream is there, or it is lost. */
  link(isLive: boolean): void;
  /** The server no longer knows who asks. */
  signedOut(): void;
}

/** Follows what a query asks for, until `close`. */
export class Stream {
  #source: EventSource | null = null;
  #heardAt = performance.now();
  #asking = false;
  /** The stream may be dead without saying so. */
  #suspect = false;
  #again: ReturnType<typeof setTimeout> | undefined;
  readonly #look: ReturnType<typeof setInterval>;

  constructor(
    /** Which events are wanted: `site=yard`. */
    readonly query: string,
    readonly listener: Partial<Listener>,
  ) {
    this.#open();
    this.#look = setInterval(() => void this.#watch(), LOOK_MS);
  }

  close(): void {
    clearInterval(this.#look);
    clearTimeout(this.#again);
    this.#source?.close();
    this.#source = null;
  }

  #open(): void {
    this.#source?.close();
    const source = new EventSource(`/v1/events?${this.query}`);
    this.#source = source;
    this.#heardAt = performance.now();
    source.onopen = () => {
      this.#heard();
      this.listener.link?.(true);
    };
    source.onerror = () => {
      this.listener.link?.(false);
      // The browser resumes by itself what only broke; an answer that refuses ends it.
      if (source.readyState === EventSource.CLOSED) void this.#reopen();
    };
    for (const name of ['snapshot_begin', 'snapshot_end', 'robot', 'mission', 'step', 'alert', 'map', 'end']) {
      source.addEventListener(name, (event: MessageEvent<string>) => {
        this.#heard();
        this.#take(JSON.parse(event.data) as Sent);
      });
    }
  }

  #heard(): void {
    this.#heardAt = performance.now();
  }

  #take(sent: Sent): void {
    const { listener } = this;
    if (sent === 'snapshot_begin') listener.begin?.();
    else if (sent === 'snapshot_end') {
      listener.whole?.();
      listener.link?.(true);
    } else if (typeof sent === 'string') return;
    else if ('robot' in sent) listener.robot?.(sent.robot);
    else if ('mission' in sent) listener.mission?.(sent.mission);
    else if ('step' in sent) listener.step?.(sent.step);
    else if ('alert' in sent) listener.alert?.(sent.alert);
    else if ('map' in sent) listener.map?.(sent.map);
    else if ('end' in sent) void this.#reopen();
  }

  async #watch(): Promise<void> {
    if (this.#asking || !this.#source) return;
    if (performance.now() - this.#heardAt < SILENCE_MAX_MS) return;
    this.#asking = true;
    try {
      await ask('/readyz', { timeoutMs: READY_MAX_MS });
      this.#heard();
      if (this.#suspect && this.#source) this.#open();
      this.#suspect = false;
    } catch {
      this.#suspect = true;
      this.listener.link?.(false);
    } finally {
      this.#asking = false;
    }
  }

  async #reopen(): Promise<void> {
    if (!this.#source) return;
    this.#source.close();
    clearTimeout(this.#again);
    try {
      await ask('/v1/session', { timeoutMs: READY_MAX_MS });
    } catch (error) {
      if (error instanceof Problem && error.status === 401) {
        this.listener.signedOut?.();
        return;
      }
    }
    // Closed meanwhile: nobody listens any more.
    if (this.#source) this.#again = setTimeout(() => this.#open(), AGAIN_MS);
  }
}

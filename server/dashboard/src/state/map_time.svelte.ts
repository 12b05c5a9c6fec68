// The time of the friction map: the present, or the end of a minute, hour, day or month that is past; and its play.
import { momentsOf, momentsWith, type Span } from '../map/moments';
import { serverClock } from '../server_clock';

/** How long each time is shown while they play, milliseconds. */
const SHOWN_MS = 600;

export class MapTime {
  span = $state<Span>('day');
  /** Oldest first; behind the last one comes the present. */
  moments = $state.raw(momentsOf('day', serverClock.now()));
  index = $state(this.moments.length);
  isRunning = $state(false);
  /** The time that the server has rounded to, as it states it. */
  stated = $state<string | null>(null);

  constructor(
    /** Reads the map of another time. */
    readonly read: () => Promise<void>,
  ) {}

  /** The time that is asked for; null for the present. */
  get at_ms(): number | null {
    return this.moments[this.index] ?? null;
  }

  /** Goes back to the present with the times of another span. */
  choose(span: Span): void {
    const wasPast = this.at_ms !== null;
    this.pause();
    this.span = span;
    this.moments = momentsOf(span, serverClock.now());
    this.index = this.moments.length;
    if (wasPast) void this.read();
  }

  seek(index: number): void {
    this.pause();
    this.#follow();
    this.index = index;
    void this.read();
  }

  /** Shows the map of a time, or of the present; without reading it. */
  bringBack(wanted: { at_ms: number; span: Span } | null): void {
    this.pause();
    if (!wanted) {
      this.index = this.moments.length;
      return;
    }
    const { span, moments, index } = momentsWith(wanted.at_ms, wanted.span, serverClock.now());
    this.span = span;
    this.moments = moments;
    this.index = index;
  }

  toggle(): void {
    if (this.isRunning) this.pause();
    else void this.#run();
  }

  pause(): void {
    this.isRunning = false;
  }

  /** From the present on, the times are those up to now. */
  #follow(): void {
    if (this.at_ms === null) this.moments = momentsOf(this.span, serverClock.now());
  }

  async #run(): Promise<void> {
    if (this.at_ms === null) {
      this.#follow();
      this.index = 0;
    }
    this.isRunning = true;
    for (;;) {
      await this.read();
      await new Promise((resolve) => setTimeout(resolve, SHOWN_MS));
      if (!this.isRunning) return;
      if (this.at_ms === null) break;
      this.index += 1;
    }
    this.isRunning = false;
  }
}

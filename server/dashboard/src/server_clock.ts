// The time of the server, as far as its answers state it: the clock of this machine may be wrong.
//
// Each answer has the header `Date`, which states whole seconds. An answer with the date D, for a request that was sent
// at the monotonic time a and answered at b, means that the server's time less the monotonic time lies between D − b
// and D + 1 s − a. What several answers leave is their intersection. The clock of this machine counts as far as it
// agrees with that.

/** What the header `Date` leaves out, milliseconds. */
const DATE_STEP_MS = 1_000;

/** A request and its answer, monotonic, milliseconds. */
export interface Exchange {
  sentAt: number;
  answeredAt: number;
}

export class ServerClock {
  /** Between these lies the server's time less the monotonic time, milliseconds. */
  #least_ms = -Infinity;
  #most_ms = Infinity;

  constructor(
    readonly monotonic: () => number = () => performance.now(),
    /** The clock of this machine. */
    readonly wall: () => number = () => Date.now(),
  ) {}

  /** Takes the header `Date` of an answer. */
  heard(date: string | null, { sentAt, answeredAt }: Exchange): void {
    const stated_ms = date === null ? NaN : Date.parse(date);
    if (Number.isNaN(stated_ms)) return;
    const [least_ms, most_ms] = [stated_ms - answeredAt, stated_ms + DATE_STEP_MS - sentAt];
    const isAgreed = least_ms <= this.#most_ms && most_ms >= this.#least_ms;
    // A clock was set, or the machine slept: what was heard before says nothing any more.
    this.#least_ms = isAgreed ? Math.max(this.#least_ms, least_ms) : least_ms;
    this.#most_ms = isAgreed ? Math.min(this.#most_ms, most_ms) : most_ms;
  }

  /** The server's time, milliseconds since 1970. */
  now(): number {
    return this.at(this.monotonic());
  }

  /** The server's time at a monotonic time, milliseconds since 1970. */
  at(monotonic_ms: number): number {
    const own_ms = this.wall() - this.monotonic();
    return monotonic_ms + Math.min(Math.max(own_ms, this.#least_ms), this.#most_ms);
  }
}

export const serverClock = new ServerClock();

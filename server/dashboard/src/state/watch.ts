// Watches robots that are opened or selected through their drive sockets, without a lease: each says ten times a
// second where its robot is, the stream of events once a second. Bounded; not reactive.
import type { DriveUpdate, DriveView } from '../api/schema';

/**
 * Robots that one page watches at most: each is a socket, of which a token has 64, and has its agent publish more
 * often.
 */
export const WATCHED_MAX = 6;
/** Wait before a socket that was lost is opened again, milliseconds. */
const AGAIN_MS = 10_000;

export class Watch {
  #site: string | null = null;
  readonly #watched = new Map<string, Socket>();

  constructor(readonly heard: (robot: string, view: DriveView) => void) {
    document.addEventListener('visibilitychange', () => {
      for (const socket of this.#watched.values()) socket.look();
    });
  }

  /** Watches these robots of a site from now on, and no others. */
  follow(site: string | null, robots: readonly string[]): void {
    const wanted = new Set(site === null ? [] : robots.slice(0, WATCHED_MAX));
    for (const [robot, socket] of this.#watched) {
      if (site === this.#site && wanted.has(robot)) continue;
      socket.close();
      this.#watched.delete(robot);
    }
    this.#site = site;
    const scheme = location.protocol === 'https:' ? 'wss' : 'ws';
    for (const robot of wanted) {
      if (this.#watched.has(robot)) continue;
      const address = `${scheme}://${location.host}/v1/sites/${site}/robots/${robot}/drive`;
      this.#watched.set(robot, new Socket(address, (view) => this.heard(robot, view)));
    }
  }
}

/** One robot that is watched: its socket, opened again when it was lost. */
class Socket {
  #socket: WebSocket | null = null;
  #again: ReturnType<typeof setTimeout> | undefined;

  constructor(
    readonly address: string,
    readonly heard: (view: DriveView) => void,
  ) {
    this.look();
  }

  /** Nobody looks at a hidden page. */
  look(): void {
    if (document.hidden) this.close();
    else if (!this.#socket) this.#open();
  }

  close(): void {
    clearTimeout(this.#again);
    const socket = this.#socket;
    this.#socket = null;
    socket?.close();
  }

  #open(): void {
    clearTimeout(this.#again);
    const socket = new WebSocket(this.address);
    this.#socket = socket;
    socket.onmessage = (event: MessageEvent<string>) => {
      const update = JSON.parse(event.data) as DriveUpdate;
      if (this.#socket === socket && 'view' in update) this.heard(update.view);
    };
    socket.onclose = () => {
      if (this.#socket !== socket) return;
      this.#socket = null;
      // The stream of events goes on saying where the robot is.
      this.#again = setTimeout(() => this.look(), AGAIN_MS);
    };
  }
}

// Watches the selected robot through its drive socket, without a lease: it says ten times a second
// where the robot is, the stream of events once a second. One socket at most; not reactive.
import type { DriveUpdate, DriveView } from '../api/schema';

/** Wait before a socket that was lost is opened again, milliseconds. */
const AGAIN_MS = 10_000;

export class Watch {
  #socket: WebSocket | null = null;
  /** The address of the socket that is wanted; null for none. */
  #wanted: string | null = null;
  #robot = '';
  #again: ReturnType<typeof setTimeout> | undefined;

  constructor(readonly heard: (robot: string, view: DriveView) => void) {
    document.addEventListener('visibilitychange', () => this.#look());
  }

  /** Watches this robot from now on, or none. */
  follow(site: string | null, robot: string | null): void {
    const scheme = location.protocol === 'https:' ? 'wss' : 'ws';
    const wanted = site && robot ? `${scheme}://${location.host}/v1/sites/${site}/robots/${robot}/drive` : null;
    if (wanted === this.#wanted) return;
    this.#close();
    this.#wanted = wanted;
    this.#robot = robot ?? '';
    this.#look();
  }

  /** Nobody looks at a hidden page. */
  #look(): void {
    if (document.hidden) this.#close();
    else if (this.#wanted && !this.#socket) this.#open(this.#wanted);
  }

  #open(address: string): void {
    clearTimeout(this.#again);
    const socket = new WebSocket(address);
    const robot = this.#robot;
    this.#socket = socket;
    socket.onmessage = (event: MessageEvent<string>) => {
      const update = JSON.parse(event.data) as DriveUpdate;
      if (this.#socket === socket && 'view' in update) this.heard(robot, update.view);
    };
    socket.onclose = () => {
      if (this.#socket !== socket) return;
      this.#socket = null;
      // The stream of events goes on saying where the robot is.
      this.#again = setTimeout(() => this.#look(), AGAIN_MS);
    };
  }

  #close(): void {
    clearTimeout(this.#again);
    const socket = this.#socket;
    this.#socket = null;
    socket?.close();
  }
}

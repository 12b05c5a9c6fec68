// Teleoperation: the socket, the lease, and the motion that the operator commands. Whatever goes wrong means zero.
import type { DriveUpdate, DriveView, Lease } from '../api/schema';
import type { Said } from '../message';
import { texts } from '../texts';
import { KEYS, clamped, inputOfAxes, inputOfKeys, type DriveInput } from './drive_input';

/** Time between two drive commands, milliseconds; the server asks for 50 to 100. */
const COMMAND_MS = 80;
/** How long one command lasts, milliseconds. */
const FOR_MS = 250;
export type Connection = 'off' | 'connecting' | 'open';

export class Drive {
  robot = $state<string | null>(null);
  connection = $state<Connection>('off');
  lease = $state.raw<Lease | null>(null);
  view = $state.raw<DriveView | null>(null);
  /** Said in one sentence; null when there is nothing to say. */
  said = $state<Said | null>(null);
  /** Who has the lease that this page was refused. */
  isTakenByOther = $state(false);
  /** Shares of the robot's own limits. */
  speedShare = $state(0.5);
  turnShare = $state(0.5);
  input = $state.raw<DriveInput>({ forward: 0, left: 0 });
  gamepad = $state<string | null>(null);

  #socket: WebSocket | null = null;
  #client = '';
  #pressed = new Set<string>();
  #stick: DriveInput | null = null;
  #timer: ReturnType<typeof setInterval> | undefined;
  #limits = { linear_m_s: 0, angular_rad_s: 0 };
  #wasZero = true;

  constructor(
    readonly driver: () => string,
    /** Hears where the robot is, more often than the stream of events says it. */
    readonly heard: (robot: string, view: DriveView) => void,
  ) {
    addEventListener('blur', () => this.#rest(() => texts.drive.zero.blur));
    document.addEventListener('visibilitychange', () => {
      if (document.hidden) this.#rest(() => texts.drive.zero.hidden);
    });
    addEventListener('pagehide', () => this.close());
  }

  get hasLease(): boolean {
    return this.lease !== null;
  }

  begin(site: string, robot: string, limits: { linear_max_m_s: number; angular_max_rad_s: number }): void {
    this.close();
    this.robot = robot;
    this.#limits = { linear_m_s: limits.linear_max_m_s, angular_rad_s: limits.angular_max_rad_s };
    this.connection = 'connecting';
    this.said = null;
    const scheme = location.protocol === 'https:' ? 'wss' : 'ws';
    const socket = new WebSocket(`${scheme}://${location.host}/v1/sites/${site}/robots/${robot}/drive`);
    this.#socket = socket;
    socket.onmessage = (event: MessageEvent<string>) => this.#take(JSON.parse(event.data) as DriveUpdate);
    socket.onclose = () => {
      if (this.#socket !== socket) return;
      const had = this.hasLease || this.connection === 'connecting';
      this.#off();
      if (had) this.said ??= () => texts.drive.zero.lost;
    };
  }

  take(): void {
    this.#send({ take: { name: this.driver() } });
  }

  release(): void {
    this.#send({ release: {} });
    this.close();
  }

  /** Closes the socket: the server tells the robot to stand. */
  close(): void {
    const socket = this.#socket;
    this.#off();
    this.said = null;
    this.robot = null;
    socket?.close();
  }

  /** A key goes down or up; true if it drives. */
  key(code: string, isDown: boolean): boolean {
    if (!this.hasLease || !(code in KEYS)) return false;
    if (isDown) this.#pressed.add(code);
    else this.#pressed.delete(code);
    if (isDown) this.said = null;
    this.#command();
    return true;
  }

  /** The touch stick: where it is, or null when it is let go. */
  stick(input: DriveInput | null): void {
    this.#stick = input && clamped(input);
    if (input) this.said = null;
    this.#command();
  }

  /** Commands zero at once, whatever was commanded. */
  letGo(): void {
    this.#pressed.clear();
    this.#stick = null;
    this.#command();
  }

  #rest(why: Said): void {
    if (!this.hasLease) return;
    const moved = !this.#wasZero;
    this.letGo();
    if (moved) this.said = why;
  }

  #off(): void {
    clearInterval(this.#timer);
    this.#socket = null;
    this.connection = 'off';
    this.lease = null;
    this.view = null;
    this.isTakenByOther = false;
    this.#pressed.clear();
    this.#stick = null;
    this.#wasZero = true;
    this.input = { forward: 0, left: 0 };
    this.gamepad = null;
  }

  #take(update: DriveUpdate): void {
    if ('welcome' in update) {
      this.connection = 'open';
      this.#client = update.welcome.client;
      this.#send({ acquire: { name: this.driver() } });
    } else if ('leased' in update) {
      if (update.leased.driver.client !== this.#client) return;
      this.lease = update.leased;
      this.isTakenByOther = false;
      this.said = null;
      clearInterval(this.#timer);
      this.#timer = setInterval(() => this.#command(), COMMAND_MS);
    } else if ('released' in update) {
      clearInterval(this.#timer);
      this.lease = null;
      this.#pressed.clear();
      this.#stick = null;
      this.input = { forward: 0, left: 0 };
      const { cause, detail } = update.released;
      this.said = () => texts.drive.released(cause, detail);
      this.isTakenByOther = update.released.cause === 'taken';
    } else if ('refused' in update) {
      // A command that was under way when the lease was lost: why it was lost stays written.
      if (update.refused.cause === 'no_lease' && !this.hasLease) return;
      // That the robot is stopped is shown as long as it is so, with what to do.
      if (update.refused.cause === 'stopped' && this.view?.safety.stop) return;
      const { cause, detail } = update.refused;
      this.said = () => texts.drive.refused(cause, detail);
      this.isTakenByOther = update.refused.cause === 'leased';
    } else if ('view' in update) {
      this.view = update.view;
      if (this.robot) this.heard(this.robot, update.view);
    } else if ('ended' in update) {
      const { detail } = update.ended;
      this.said = () => texts.drive.released('ended', detail);
    }
  }

  #readInput(): DriveInput {
    if (document.hidden || !document.hasFocus()) return { forward: 0, left: 0 };
    if (this.#stick) return this.#stick;
    if (this.#pressed.size > 0) return inputOfKeys(this.#pressed);
    const pad = navigator.getGamepads().find((pad) => pad?.connected);
    this.gamepad = pad?.id ?? null;
    return pad ? inputOfAxes(pad.axes[0] ?? 0, pad.axes[1] ?? 0) : { forward: 0, left: 0 };
  }

  #command(): void {
    if (!this.hasLease) return;
    this.input = this.#readInput();
    const isZero = this.input.forward === 0 && this.input.left === 0;
    this.#wasZero = isZero;
    this.#send({
      drive: {
        linear_m_s: this.input.forward * this.speedShare * this.#limits.linear_m_s,
        angular_rad_s: this.input.left * this.turnShare * this.#limits.angular_rad_s,
        for_ms: FOR_MS,
      },
    });
  }

  #send(request: object): void {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(request));
  }
}

// Calls for whoever does not look at the page: a sound, and a notification of the browser, when an alert is raised.
import type { Alert } from '../api/schema';
import { texts } from '../texts';

const KEYS = { sound: 'tread-sound', notices: 'tread-notices' } as const;
/** Alerts that are raised within this time are one call, milliseconds. */
const TOGETHER_MS = 500;
/** Pitch and length of a tone, and the time from one to the next. */
const TONE = { frequency_hz: 880, length_s: 0.15, apart_s: 0.25, loudness_ratio: 0.15 };
/** Tones of each severity. */
const TONES: Record<Alert['severity'], number> = { warning: 1, critical: 3 };

export class Attention {
  sound = $state(localStorage.getItem(KEYS.sound) !== null);
  notices = $state(localStorage.getItem(KEYS.notices) !== null && isAllowed());
  /** The browser was asked for notifications and refuses them. */
  isRefused = $state(false);

  #raised: Alert[] = [];
  #due: ReturnType<typeof setTimeout> | undefined;
  #audio: AudioContext | null = null;

  constructor(
    /** Shows the alerts, and one of them if one is given. */
    readonly open: (alert: Alert | null) => void,
    /** Whom or what an alert is about, with its site if there are several. */
    readonly about: (alert: Alert) => string,
  ) {}

  /** Turns the sound on or off; on, it is heard once. */
  setSound(isOn: boolean): void {
    this.sound = isOn;
    keep(KEYS.sound, isOn);
    if (isOn) this.#play(1);
  }

  /** Turns notifications on or off; the browser asks whoever looks. */
  async setNotices(isOn: boolean): Promise<void> {
    const isGranted = isOn && 'Notification' in globalThis && (await Notification.requestPermission()) === 'granted';
    this.notices = isGranted;
    this.isRefused = isOn && !isGranted;
    keep(KEYS.notices, isGranted);
  }

  /** An alert was raised. */
  raised(alert: Alert): void {
    this.#raised.push(alert);
    this.#due ??= setTimeout(() => this.#call(), TOGETHER_MS);
  }

  #call(): void {
    const alerts = this.#raised;
    this.#raised = [];
    this.#due = undefined;
    const first = alerts.find((alert) => alert.severity === 'critical') ?? alerts[0];
    if (!first) return;
    if (this.sound) this.#play(TONES[first.severity]);
    if (!this.notices || !isAllowed() || document.hasFocus()) return;
    const isAlone = alerts.length === 1;
    const worst = `${this.about(first)}: ${texts.alerts.title(first.code)}`;
    const said = texts.alerts.notice(texts.alerts.sentence(first.code, this.about(first)), first.text);
    const [title, body] = isAlone ? [worst, said] : [texts.alerts.several(alerts.length), said];
    const notice = new Notification(`${texts.name}: ${title}`, { body, tag: first.id });
    notice.onclick = () => {
      window.focus();
      this.open(isAlone ? first : null);
      notice.close();
    };
  }

  #play(tones: number): void {
    this.#audio ??= new AudioContext();
    const audio = this.#audio;
    // A page on which nobody has clicked yet may not sound.
    void audio.resume();
    for (let tone = 0; tone < tones; tone += 1) {
      const begin_s = audio.currentTime + tone * TONE.apart_s;
      const [source, gain] = [audio.createOscillator(), audio.createGain()];
      source.frequency.value = TONE.frequency_hz;
      gain.gain.value = TONE.loudness_ratio;
      source.connect(gain).connect(audio.destination);
      source.start(begin_s);
      source.stop(begin_s + TONE.length_s);
    }
  }
}

function isAllowed(): boolean {
  return 'Notification' in globalThis && Notification.permission === 'granted';
}

function keep(key: string, isOn: boolean): void {
  if (isOn) localStorage.setItem(key, 'on');
  else localStorage.removeItem(key);
}

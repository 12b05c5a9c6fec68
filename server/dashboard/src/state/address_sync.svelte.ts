// Keeps what is shown, selected and drawn in the address of the page, and brings it back from there.
import { CHANGE, HIDEABLE, addressOf, placeAtStart, placeOf, type DraftState, type Hideable, type Place } from '../address';
import { RANGES, type Quantity } from '../map/friction';
import type { Editor } from './editor.svelte';
import type { Fleet } from './fleet.svelte';
import type { Roster } from './roster.svelte';
import type { View } from './view.svelte';

/** Wait after a change before the address says so, milliseconds. */
const WRITE_MS = 200;
/** The whole of it, as long as it may be, for the tab alone: for long drafts, and over a sign-in elsewhere. */
const TAB_KEY = 'tread-place';
/** The address that the page had put in last when it went; none if somebody has put in another one since. */
const LAST_ADDRESS_KEY = 'tread-address';

export class AddressSync {
  /** What the address wants and is not brought back yet, since what it is about has not been read. */
  #wanted: Place | null;
  draft = $state.raw<DraftState | null>(null);
  #due: ReturnType<typeof setTimeout> | undefined;
  /** The address as this page found it, or has put it in since. */
  #address: string;

  constructor(
    readonly fleet: Fleet,
    readonly roster: Roster,
    readonly view: View,
    readonly editor: Editor,
  ) {
    this.#wanted = placeAtStart(location.hash, {
      place: sessionStorage.getItem(TAB_KEY) ?? '',
      address: sessionStorage.getItem(LAST_ADDRESS_KEY),
      isReload: isReload(),
    });
    // For this start alone: a page that crashes leaves none, and its address counts.
    sessionStorage.removeItem(LAST_ADDRESS_KEY);
    this.#address = location.hash;
    fleet.wantedSite = this.#wanted.site;
  }

  /** Everything as it is now. */
  get place(): Place {
    const { fleet, roster, view, editor } = this;
    const shown: Record<Hideable, boolean> = { terrains: view.showTerrains, fence: view.showFence, trails: view.showTrails };
    return {
      site: fleet.site,
      tab: view.tab,
      robot: fleet.selected,
      marked: [...roster.marked],
      view: view.place,
      layer: view.compare.isOn ? CHANGE : (view.quantity ?? ''),
      time: view.quantity === null || view.time.at_ms === null ? null : { at_ms: view.time.at_ms, span: view.time.span },
      compared: view.compare.isOn ? view.compare.times : null,
      hidden: HIDEABLE.filter((name) => !shown[name]),
      alert: view.tab === 'alerts' ? view.alert : null,
      draft: this.draft ?? editor.state,
    };
  }

  /** Brings back what the address wants, once its site is there. */
  begin(): void {
    const wanted = this.#wanted;
    this.#wanted = null;
    if (!wanted) return;
    if (wanted.site === this.fleet.site) this.#bringBack(wanted);
    // An alert about the server is of no site.
    else if (wanted.site === null && wanted.alert) this.#openAlert(wanted);
  }

  /** Whoever signs in again finds everything as it was. */
  pause(): void {
    if (this.fleet.site) this.#wanted = this.place;
  }

  /** Somebody has put another address in. */
  changed(): void {
    const place = placeOf(location.hash);
    if (place.site === this.fleet.site) this.#bringBack(place);
    else if (place.alert && (place.site === null || this.fleet.sites.some(({ id }) => id === place.site))) {
      if (place.site !== null) this.fleet.choose(place.site);
      this.#openAlert(place);
    } else return;
    this.#address = location.hash;
  }

  #openAlert({ tab, alert }: Place): void {
    this.view.tab = tab;
    this.view.alert = alert;
  }

  #bringBack(place: Place): void {
    const { fleet, roster, view, editor } = this;
    view.tab = place.tab;
    fleet.selected = place.robot;
    roster.unmark();
    for (const id of place.marked) roster.marked.add(id);
    view.showTerrains = !place.hidden.includes('terrains');
    view.showFence = !place.hidden.includes('fence');
    view.showTrails = !place.hidden.includes('trails');
    view.alert = place.alert;
    if (place.view) view.wantedPlace = place.view;
    this.#bringBackLayer(place);
    if (!editor.purpose) this.draft = place.draft;
    fleet.isDirty = true;
  }

  #bringBackLayer(place: Place): void {
    const { view } = this;
    const now = this.place;
    const isSame = (['layer', 'time', 'compared'] as const).every((name) => JSON.stringify(now[name]) === JSON.stringify(place[name]));
    if (isSame) return;
    view.time.bringBack(place.time);
    view.compare.end();
    view.choose(place.layer in RANGES ? (place.layer as Quantity) : null);
    if (place.layer !== CHANGE) return;
    if (place.compared) view.compare.bringBack(place.compared);
    view.compare.begin();
  }

  /** Goes on with the draft as soon as what it changes is known. */
  goOn(): void {
    const { draft, editor } = this;
    if (draft && editor.goOnWith(draft)) this.draft = null;
  }

  /** Says soon in the address how everything is. */
  write(): void {
    // Read now, so that whoever calls this in an effect is called again.
    const place = this.place;
    clearTimeout(this.#due);
    if (!place.site || this.#wanted) return;
    this.#due = setTimeout(() => this.#put(place), WRITE_MS);
  }

  /** Before the page goes. */
  flush(): void {
    clearTimeout(this.#due);
    if (this.fleet.site && !this.#wanted && location.hash === this.#address) {
      sessionStorage.setItem(LAST_ADDRESS_KEY, this.#address);
      this.#put(this.place);
    } else {
      // What the address wants was not brought back, so it is not this tab's own.
      sessionStorage.removeItem(LAST_ADDRESS_KEY);
    }
  }

  #put(place: Place): void {
    const address = `#${addressOf(place)}`;
    if (address !== location.hash) history.replaceState(null, '', address);
    this.#address = location.hash;
    sessionStorage.setItem(TAB_KEY, addressOf(place, Infinity));
  }
}

/** Returns whether this page was loaded by a reload. */
function isReload(): boolean {
  const [navigation] = performance.getEntriesByType('navigation');
  return navigation instanceof PerformanceNavigationTiming && navigation.type === 'reload';
}

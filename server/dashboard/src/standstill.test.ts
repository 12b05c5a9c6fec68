import { expect, test } from 'vitest';
import type { RobotLive, RobotMode, StandstillState, Stop } from './api/schema';
import { STOP_STATES, doing, hasFault, isRed, stopState, stopWord } from './standstill';
import { DICTIONARIES } from './texts';

const live = (mode: RobotMode, state?: StandstillState): RobotLive =>
  ({ mode, safety: { standstill: state ? { state } : null } }) as RobotLive;
const stop = (confirmed_at: string | null): Stop => ({ robot: 'rover-1', confirmed_at }) as Stop;
const AT = '2026-11-22T06:00:00Z';

test('a robot that is to stand and moves is said so, whatever its mode', () => {
  for (const mode of ['stopped', 'idle', 'fault', 'tracking'] as const) {
    expect(doing(live(mode, 'standstill_not_reached'))).toEqual({ text: 'STILL MOVING', isBad: true });
    expect(doing(live(mode, 'unexpected_motion')).isBad).toBe(true);
  }
  expect(doing(live('stopped', 'stopping'))).toEqual({ text: 'stopping', isBad: false });
  expect(doing(live('stopped', 'standstill')).text).toBe('stopped, stands still');
  expect(doing(live('tracking', 'standstill')).text).toBe('on a mission');
  expect(doing(live('tracking')).isBad).toBe(false);
  expect(doing(null).isBad).toBe(false);
});

test('a stop is red until it is confirmed, and again where its robot is still moving', () => {
  expect(stopState(stop(null), live('stopped', 'standstill'))).toBe('unconfirmed');
  expect(stopState(stop(AT), live('stopped', 'stopping'))).toBe('stopping');
  expect(stopState(stop(AT), live('stopped', 'standstill'))).toBe('standstill');
  expect(stopState(stop(AT), live('stopped', 'standstill_not_reached'))).toBe('runs');
  expect(stopState(stop(AT), live('stopped', 'unexpected_motion'))).toBe('moves');
  expect(STOP_STATES.filter(isRed)).toEqual(['runs', 'moves', 'unconfirmed']);
});

test('each state of a stop is one sentence with a robot, who stopped it, and a full stop', () => {
  const { en } = DICTIONARIES;
  expect(en.stop.states.standstill('rover-1', 'demo')).toBe('rover-1: stopped by demo. The robot stands still.');
  for (const { stop: said } of Object.values(DICTIONARIES)) {
    for (const state of STOP_STATES) {
      const sentence = said.states[state]('rover-1', 'demo');
      expect(sentence).toMatch(/^rover-1.*\bdemo\b.*\.$/);
      expect(sentence).not.toMatch(/befohlen|commanded/);
    }
    // What begins a sentence is no lower-case word.
    for (const sentence of [said.sending(said.everyRobot), said.failed(said.everyRobot), said.refused(said.everyRobot, 'x')]) {
      expect(sentence).toMatch(/^\p{Lu}/u);
    }
  }
});

test('the bar of stops, what was done to several and the card of a robot call a state alike', () => {
  expect(stopWord('standstill')).toBe(doing(live('stopped', 'standstill')).text);
  expect(stopWord('stopping')).toBe(doing(live('stopped', 'stopping')).text);
  expect(stopWord('runs')).toBe(doing(live('stopped', 'standstill_not_reached')).text);
});

test('a robot is in fault by its mode or by what it says', () => {
  expect(hasFault({ ...live('fault'), fault: null })).toBe(true);
  expect(hasFault({ ...live('idle'), fault: 'a motor is too hot' })).toBe(true);
  expect(hasFault({ ...live('idle'), fault: null })).toBe(false);
  expect(hasFault(null)).toBe(false);
});

import { expect, test } from 'vitest';
import type { RobotLive, RobotMode, StandingState, Stop } from './api/schema';
import { doing, stopped } from './standing';

const live = (mode: RobotMode, state?: StandingState): RobotLive =>
  ({ mode, safety: { standing: state ? { state } : null } }) as RobotLive;
const stop = (confirmed_at: string | null): Stop => ({ robot: 'rover-1', confirmed_at }) as Stop;
const AT = '2026-11-22T06:00:00Z';

test('a robot that is to stand and moves is said so, whatever its mode', () => {
  for (const mode of ['stopped', 'idle', 'fault', 'tracking'] as const) {
    expect(doing(live(mode, 'does_not_stand'))).toEqual({ text: 'DOES NOT STAND', isBad: true });
    expect(doing(live(mode, 'moves')).isBad).toBe(true);
  }
  expect(doing(live('stopped', 'stopping'))).toEqual({ text: 'stopping', isBad: false });
  expect(doing(live('stopped', 'standing')).text).toBe('stopped, stands');
  expect(doing(live('tracking', 'standing')).text).toBe('on a mission');
  expect(doing(live('tracking')).isBad).toBe(false);
  expect(doing(null).isBad).toBe(false);
});

test('a stop is red until it is confirmed, and again where its robot does not stand', () => {
  expect(stopped(stop(null), 'rover-1', live('stopped', 'standing')).look).toBe('red');
  expect(stopped(stop(AT), 'rover-1', live('stopped', 'stopping'))).toEqual({
    text: 'rover-1 is stopping: its wheels are commanded to rest',
    look: 'held',
  });
  expect(stopped(stop(AT), 'rover-1', live('stopped', 'standing')).text).toContain('stands');
  expect(stopped(stop(AT), 'rover-1', live('stopped', 'does_not_stand')).look).toBe('red');
  expect(stopped(stop(AT), 'rover-1', live('stopped', 'moves')).look).toBe('red');
});

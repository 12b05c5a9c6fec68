//! Payloads that are damaged in the ways in which payloads are damaged.

use crate::random::Random;

/// Most bytes that a payload grows by.
const GROWTH_BYTES_MAX: usize = 64 * 1024;

/// Damages a payload in one of the ways in which payloads are damaged.
pub fn damage(payload: &mut Vec<u8>, random: &mut Random) {
    for _ in 0..=random.index(4) {
        let at = random.index(payload.len().max(1));
        match random.index(6) {
            0 => {
                if let Some(byte) = payload.get_mut(at) {
                    *byte ^= 1 << random.index(8);
                }
            }
            1 => payload.truncate(at),
            2 => {
                let part: Vec<u8> = payload.iter().skip(at).copied().collect();
                payload.extend(part);
            }
            3 => payload.resize(payload.len() + random.index(GROWTH_BYTES_MAX), b'9'),
            4 => {
                payload.splice(at..at, *b"[[[[[[[[");
            }
            _ => {}
        }
    }
}

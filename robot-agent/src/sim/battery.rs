//! Battery of the simulated robot, discharged by the work of the wheels and a constant load.

use std::time::Duration;

use crate::drive::Battery;

/// Energy of a full battery, joules: 150 Wh.
const CAPACITY_J: f64 = 150.0 * 3_600.0;
/// Load of computer and sensors, watts.
const IDLE_W: f64 = 12.0;
/// Fraction of the electrical power that reaches the wheels.
const EFFICIENCY_RATIO: f64 = 0.7;
/// Voltage of an empty battery, and of a full one, volts.
const VOLTAGE_V: (f64, f64) = (20.0, 25.2);

/// A battery that is never charged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SimulatedBattery {
    charge_j: f64,
}

impl SimulatedBattery {
    /// Creates a battery with a charge, 0 to 1.
    pub fn new(charge_ratio: f64) -> Self {
        Self {
            charge_j: CAPACITY_J * charge_ratio.clamp(0.0, 1.0),
        }
    }

    /// Discharges the battery for `time`; `wheels_w` is the wheels' mechanical power, watts.
    /// Negative power of braking wheels is not recovered.
    pub fn step(&mut self, wheels_w: f64, time: Duration) {
        let power_w = IDLE_W + wheels_w.max(0.0) / EFFICIENCY_RATIO;
        self.charge_j = (self.charge_j - power_w * time.as_secs_f64()).max(0.0);
    }

    /// Returns charge and voltage.
    pub fn reading(&self) -> Battery {
        let charge_ratio = self.charge_j / CAPACITY_J;
        let (empty_v, full_v) = VOLTAGE_V;
        Battery {
            charge_ratio,
            voltage_v: empty_v + charge_ratio * (full_v - empty_v),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn standing_takes_the_idle_draw_and_an_empty_battery_stays_empty() {
        let mut battery = SimulatedBattery::new(1.0);
        for _ in 0..3_600 {
            battery.step(-5.0, Duration::from_secs(1));
        }
        let left = battery.reading().charge_ratio;
        assert!((left - (1.0 - IDLE_W / 150.0)).abs() < 1.0e-9, "{left}");
        battery.step(1.0e9, Duration::from_secs(10));
        assert_eq!(battery.reading(), SimulatedBattery::new(0.0).reading());
    }
}

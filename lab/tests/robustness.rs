//! Robots of the rough world that something happens to.

use std::time::Duration;

use tread_lab::rough::disturbance::{Channel, ChannelFault, Disturbance, DisturbedTrial, run};
use tread_lab::rough::run::Course;
use tread_lab::rough::sensors::SensorSpec;
use tread_lab::rough::spec::{Deviations, MAKES};

fn trial(disturbance: Disturbance) -> DisturbedTrial {
    DisturbedTrial {
        make: MAKES[1],
        deviations: Deviations::none(3.0),
        sensors: SensorSpec::usual(true),
        course: Course::Figure8,
        seed: 5,
        disturbance,
    }
}

#[test]
fn no_disturbance_leads_beyond_a_limit_or_to_a_confidently_wrong_theta() {
    let channel = |channel, fault| Disturbance::Channel { channel, fault };
    let lasts = Duration::from_secs(2);
    for disturbance in [
        Disturbance::StartAside,
        Disturbance::PositionJump { lasts },
        Disturbance::BlockedWheels { lasts },
        channel(Channel::Gyro, ChannelFault::Frozen),
        channel(Channel::WheelTorques, ChannelFault::Zero),
        channel(Channel::Position, ChannelFault::Dropped),
    ] {
        let outcome = run(&trial(disturbance)).expect("a drive");
        assert!(outcome.estimates > 0, "{disturbance:?}: {outcome:?}");
        assert_eq!(outcome.over_limit_ticks, 0, "{disturbance:?}");
        assert!(
            !outcome.is_confidently_wrong(),
            "{disturbance:?}: {outcome:?}"
        );
    }
}

#[test]
fn ground_that_becomes_slippery_in_a_bend_leaves_no_confidently_wrong_theta() {
    let disturbance = Disturbance::GroundChange { stiffness: 0.3 };
    let mut estimates = 0;
    for (has_torque, seeds) in [
        (false, [1, 2, 7, 8, 10, 13, 19, 20].as_slice()),
        (true, &[3]),
    ] {
        for seed in seeds {
            let trial = DisturbedTrial::drawn(3_000_000 + seed, has_torque, disturbance);
            let outcome = run(&trial).expect("a drive");
            assert!(!outcome.is_confidently_wrong(), "{seed}: {outcome:?}");
            estimates += outcome.estimates;
        }
    }
    assert!(estimates > 9, "{estimates} of nine drives");
}

#[test]
fn a_robot_without_position_or_wheel_speeds_stops_and_one_without_torque_drives_on() {
    let outcome = |channel| {
        let fault = ChannelFault::Dropped;
        run(&trial(Disturbance::Channel { channel, fault })).expect("a drive")
    };
    assert!(outcome(Channel::Position).stands);
    assert!(outcome(Channel::WheelSpeeds).stands);
    assert!(outcome(Channel::Gyro).stands);
    assert!(!outcome(Channel::WheelTorques).stands);
}

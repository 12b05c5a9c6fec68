//! Measurements of tests.

use jiff::Timestamp;
use proptest::prelude::*;
use tread_api::friction::{Information, Segment, StoredSegment, ThetaErrors};
use tread_api::ids::SLUG_LENGTH_MAX;
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;
use uuid::Uuid;

use crate::archive::ArchivedSegment;

/// Finite numbers with every bit pattern.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        Just(0.0),
        Just(-0.0),
        Just(f64::MAX),
        Just(f64::MIN),
        Just(f64::MIN_POSITIVE),
        Just(f64::from_bits(1)),
        any::<u64>()
            .prop_map(f64::from_bits)
            .prop_filter("finite", |number| number.is_finite()),
    ]
}

fn information() -> impl Strategy<Value = Information> {
    (number(), number()).prop_map(|(information, weighted)| Information {
        information,
        weighted,
    })
}

fn errors() -> impl Strategy<Value = ThetaErrors> {
    (number(), number(), number()).prop_map(|(independent_information, robot_ratio, tyre_ratio)| {
        ThetaErrors {
            independent_information,
            robot_ratio,
            tyre_ratio,
        }
    })
}

fn time() -> impl Strategy<Value = Timestamp> {
    prop_oneof![Just(i64::MIN), Just(i64::MAX), any::<i64>()]
        .prop_map(|ns| Timestamp::from_nanosecond(ns.into()).unwrap())
}

fn segment() -> impl Strategy<Value = Segment> {
    let named = (
        any::<u128>(),
        prop::option::of(any::<u128>()),
        prop::option::of((
            prop_oneof!["[a-z]{1,8}", Just("a".repeat(SLUG_LENGTH_MAX))],
            any::<u32>(),
        )),
        (any::<u32>(), any::<i32>(), any::<i32>()),
        (time(), time()),
    );
    let values = (
        information(),
        prop::option::of(errors()),
        prop::option::of(information()),
        prop::option::of(information()),
        prop::option::of(number()),
        (any::<u32>(), number(), number()),
    );
    (named, values).prop_map(|(named, values)| {
        let (configuration, mission, terrain, (grid_revision, ix, iy), times) = named;
        let (theta, theta_errors, track, rolling, mu_peak_lower_bound, numbers) = values;
        Segment {
            configuration: Uuid::from_u128(configuration).into(),
            mission: mission.map(|mission| Uuid::from_u128(mission).into()),
            started_at: times.0,
            ended_at: times.1,
            grid_revision,
            cell: Cell { ix, iy },
            terrain: terrain.map(|(id, revision)| TerrainRef {
                id: id.parse().unwrap(),
                revision,
            }),
            theta,
            theta_errors,
            effective_track_ratio: track,
            rolling_resistance: rolling,
            mu_peak_lower_bound,
            samples: numbers.0,
            distance_m: numbers.1,
            saturation_ratio: numbers.2,
        }
    })
}

pub(super) fn stored() -> impl Strategy<Value = ArchivedSegment> {
    let seq = prop_oneof![Just(0), Just(i64::MAX), 0..i64::MAX];
    let received_us = -60_000_000_000_000_000_i64..200_000_000_000_000_000;
    let names = (0..3_u8, 0..4_u8, any::<u128>());
    (names, seq, received_us, segment()).prop_map(|(names, seq, received_us, segment)| {
        let (site, robot, boot) = names;
        ArchivedSegment {
            site: format!("site-{site}").parse().unwrap(),
            stored: StoredSegment {
                id: 0,
                robot: format!("rover-{robot}").parse().unwrap(),
                boot: Uuid::from_u128(boot).into(),
                seq: seq.unsigned_abs(),
                received_at: Timestamp::from_microsecond(received_us).unwrap(),
                segment,
            },
        }
    })
}

pub(super) fn numbered(first: i64, mut rows: Vec<ArchivedSegment>) -> Vec<ArchivedSegment> {
    for (id, row) in (first..).zip(&mut rows) {
        row.stored.id = id;
    }
    rows
}

pub(in crate::archive) fn rows(first: i64, count: i64) -> Vec<ArchivedSegment> {
    let row = |key: i64| ArchivedSegment {
        site: if key % 5 == 0 { "quarry" } else { "yard" }
            .parse()
            .unwrap(),
        stored: StoredSegment {
            id: key,
            robot: format!("rover-{}", key % 3).parse().unwrap(),
            boot: Uuid::from_u128(7).into(),
            seq: key.unsigned_abs(),
            received_at: Timestamp::from_microsecond(key).unwrap(),
            segment: Segment {
                configuration: Uuid::from_u128(9).into(),
                mission: None,
                started_at: Timestamp::UNIX_EPOCH,
                ended_at: Timestamp::UNIX_EPOCH,
                grid_revision: 1,
                cell: Cell { ix: 1, iy: -1 },
                terrain: (key % 2 == 0).then(|| TerrainRef {
                    id: "mud".parse().unwrap(),
                    revision: 1,
                }),
                theta: Information {
                    information: 1.5,
                    weighted: 0.25,
                },
                theta_errors: None,
                effective_track_ratio: None,
                rolling_resistance: None,
                mu_peak_lower_bound: None,
                samples: 1,
                distance_m: 1.0,
                saturation_ratio: 0.0,
            },
        },
    };
    (first..first + count).map(row).collect()
}

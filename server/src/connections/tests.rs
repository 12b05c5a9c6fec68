use proptest::prelude::*;

use super::*;

const FEW: Bounds = Bounds {
    all: 8,
    per_address: 4,
    unproven: 3,
    unproven_per_address: 2,
};

fn address(last: u8) -> IpAddr {
    [192, 0, 2, last].into()
}

fn open(connections: &Arc<Connections>, from: u8) -> Option<(Arc<Slot>, CancellationToken)> {
    let cut = CancellationToken::new();
    let admitted = connections.admit(address(from), cut.clone())?;
    Some((admitted.slot, cut))
}

#[test]
fn half_open_connections_displace_their_own_kind_and_nobody_at_work() {
    let connections = Connections::new(FEW);
    let (honest, honest_cut) = open(&connections, 1).unwrap();
    let _at_work = honest.work();
    let silent: Vec<_> = (0..50)
        .map(|number| open(&connections, number).unwrap())
        .collect();
    let alive = silent.iter().filter(|(_, cut)| !cut.is_cancelled()).count();
    assert_eq!(
        (alive, connections.count()),
        (FEW.unproven, FEW.unproven + 1)
    );
    assert!(!honest_cut.is_cancelled());
}

fn token(number: u128) -> SubjectId {
    SubjectId::Token(tread_api::ids::TokenId::from_uuid(uuid::Uuid::from_u128(
        number,
    )))
}

#[test]
fn a_request_without_a_credential_stays_unproven_however_slow_its_body_is() {
    let connections = Connections::new(FEW);
    let (honest, honest_cut) = open(&connections, 1).unwrap();
    let (_at_work, _) = honest.begin(None);
    honest.prove(token(1), Purpose::Other).unwrap();
    let slow: Vec<_> = (0..50)
        .map(|number| {
            let (slot, cut) = open(&connections, number).unwrap();
            (slot.begin(None).0, slot, cut)
        })
        .collect();
    let alive = slow
        .iter()
        .filter(|(_, _, cut)| !cut.is_cancelled())
        .count();
    assert_eq!(alive, FEW.unproven);
    assert!(!honest_cut.is_cancelled());
    let (stop, _) = open(&connections, 90).unwrap();
    let (_stopping, _) = stop.begin(None);
    assert_eq!(stop.prove(token(1), Purpose::Stop), Ok(()));
}

#[test]
fn a_stop_has_room_when_all_are_at_work_and_others_have_none() {
    let connections = Connections::new(FEW);
    let mut working = Vec::new();
    for from in 0..u8::try_from(FEW.all - FEW.unproven).unwrap() {
        let (slot, _) = open(&connections, from).unwrap();
        let (at_work, _) = slot.begin(None);
        slot.prove(token(u128::from(from)), Purpose::Other).unwrap();
        working.push((at_work, slot));
    }
    let (other, _) = open(&connections, 90).unwrap();
    let _other_at_work = other.begin(None);
    assert_eq!(
        other.prove(token(9), Purpose::Other),
        Err(ConnectionLimitError::Server)
    );
    assert_eq!(other.prove(token(9), Purpose::Stop), Ok(()));
    // An idle connection is closed to make room.
    drop(working.remove(0).0);
    let (next, _) = open(&connections, 91).unwrap();
    let _next_at_work = next.begin(None);
    assert_eq!(next.prove(token(9), Purpose::Other), Ok(()));
}

#[test]
fn each_identity_has_its_share() {
    let bounds = Bounds {
        all: 4_000,
        per_address: 4_000,
        unproven: 100,
        unproven_per_address: 100,
    };
    let connections = Connections::new(bounds);
    let prove = |identity| {
        let (slot, _) = open(&connections, 1).unwrap();
        let (at_work, _) = slot.begin(None);
        let proven = slot.prove(identity, Purpose::Other);
        (proven, at_work, slot)
    };
    let held: Vec<_> = (0..PER_IDENTITY_MAX).map(|_| prove(token(1))).collect();
    assert!(held.iter().all(|(proven, ..)| proven.is_ok()));
    assert_eq!(prove(token(1)).0, Err(ConnectionLimitError::Identity));
    assert_eq!(prove(token(2)).0, Ok(()));
    drop(held);
    assert_eq!(prove(token(1)).0, Ok(()));
}

#[test]
fn by_a_proxy_each_client_has_the_share_of_its_own_address() {
    let connections = Connections::new(FEW);
    let proxy = IpAddr::from([192, 0, 2, 80]);
    let by_proxy = |client: u8| {
        let cut = CancellationToken::new();
        let admitted = connections.admit_from(proxy, true, cut.clone()).unwrap();
        let (at_work, _) = admitted.slot.begin(Some(address(client)));
        (cut, at_work, admitted.slot)
    };
    let honest = by_proxy(1);
    let flood: Vec<_> = (0..20).map(|_| by_proxy(2)).collect();
    let alive = flood.iter().filter(|(cut, ..)| !cut.is_cancelled()).count();
    assert_eq!(alive, FEW.unproven_per_address);
    assert!(!honest.0.is_cancelled());
}

#[test]
fn one_machine_of_ipv6_is_a_whole_network() {
    let connections = Connections::new(FEW);
    let cuts: Vec<_> = (0..10_u16)
        .map(|last| {
            let peer = IpAddr::from([0x2001, 0xdb8, 0, 0, 0, 0, 0, last]);
            let cut = CancellationToken::new();
            (connections.admit(peer, cut.clone()).unwrap(), cut)
        })
        .collect();
    let alive = cuts.iter().filter(|(_, cut)| !cut.is_cancelled()).count();
    assert_eq!(alive, FEW.unproven_per_address);
}

#[test]
fn when_full_the_longest_idle_goes_first_and_none_at_work() {
    let connections = Connections::new(FEW);
    let mut working = Vec::new();
    for from in 0..8 {
        let (slot, cut) = open(&connections, from).unwrap();
        working.push((slot.work(), slot, cut));
    }
    assert!(open(&connections, 9).is_none(), "all are at work");
    let (at_work, _slot, first_cut) = working.remove(3);
    drop(at_work);
    let (at_work, _other_slot, second_cut) = working.remove(0);
    drop(at_work);
    let (_slot, _) = open(&connections, 9).unwrap();
    assert!(first_cut.is_cancelled() && !second_cut.is_cancelled());
    assert!(working.iter().all(|(_, _, cut)| !cut.is_cancelled()));
}

#[test]
fn one_address_has_its_share_and_this_machine_all_of_it() {
    let connections = Connections::new(FEW);
    let busy: Vec<_> = (0..FEW.per_address)
        .map(|_| {
            let (slot, _) = open(&connections, 7).unwrap();
            (slot.work(), slot)
        })
        .collect();
    let (slot, cut) = open(&connections, 7).unwrap();
    let _at_work = slot.work();
    assert!(cut.is_cancelled());
    assert!(open(&connections, 8).is_some());
    drop((busy, slot));
    let local: Vec<_> = (0..FEW.all)
        .map(|_| {
            let here = IpAddr::from([127, 0, 0, 1]);
            let admitted = connections.admit(here, CancellationToken::new()).unwrap();
            (admitted.slot.work(), admitted.slot)
        })
        .collect();
    assert_eq!(connections.count(), local.len());
}

#[test]
fn an_address_that_is_full_of_work_still_stops() {
    let connections = Connections::new(FEW);
    let ask = |purpose| {
        let (slot, cut) = open(&connections, 7).expect("the stop gets as far as its credential");
        let (at_work, _) = slot.begin(None);
        (slot.prove(token(1), purpose), at_work, slot, cut)
    };
    let busy: Vec<_> = (0..FEW.per_address).map(|_| ask(Purpose::Other)).collect();
    assert!(busy.iter().all(|(proven, ..)| proven.is_ok()));
    assert_eq!(
        ask(Purpose::Other).0,
        Err(ConnectionLimitError::Address(FEW.per_address))
    );
    let stops: Vec<_> = (0..2).map(|_| ask(Purpose::Stop)).collect();
    for (proven, .., cut) in busy.iter().chain(&stops) {
        assert!(proven.is_ok() && !cut.is_cancelled());
    }
}

#[test]
fn whoever_asks_without_end_is_delayed_and_nobody_else_is() {
    let connections = Connections::new(BOUNDS);
    let known = |identity| {
        let (slot, _) = open(&connections, 7).unwrap();
        let (at_work, _) = slot.begin(None);
        slot.prove(token(identity), Purpose::Other).unwrap();
        drop(at_work);
        slot
    };
    let now = Instant::now();
    let (flood, other_of_flood, honest) = (known(1), known(1), known(2));
    let mut asked = 0;
    let mut delay = Duration::ZERO;
    while delay < Duration::from_millis(500) {
        delay = flood.delay(Purpose::Other, now);
        asked += 1;
    }
    assert!((2_000..3_000).contains(&asked), "{asked} without a delay");
    assert!(other_of_flood.delay(Purpose::Other, now) >= Duration::from_millis(500));
    assert_eq!(honest.delay(Purpose::Other, now), Duration::ZERO);
    assert_eq!(flood.delay(Purpose::Stop, now), Duration::ZERO);
    let later = now + Duration::from_secs(10);
    assert_eq!(flood.delay(Purpose::Other, later), Duration::ZERO);
    let (stranger, _) = open(&connections, 9).unwrap();
    let delays = (0..10_000).map(|_| stranger.delay(Purpose::Stop, now));
    let at_once = delays.take_while(Duration::is_zero).count();
    assert!(at_once < 100, "{at_once} of a stranger");
}

#[test]
fn one_identity_does_not_fill_the_room_of_stops() {
    let bounds = Bounds {
        all: 1_000,
        per_address: 1,
        unproven: 900,
        unproven_per_address: 900,
    };
    let connections = Connections::new(bounds);
    let stop = |identity| {
        let (slot, _) = open(&connections, 7).unwrap();
        let (at_work, _) = slot.begin(None);
        (slot.prove(token(identity), Purpose::Stop), at_work, slot)
    };
    // The first connection takes the only place of the address.
    let viewer: Vec<_> = (0..=STOPS_PER_IDENTITY_MAX).map(|_| stop(1)).collect();
    assert!(viewer.iter().all(|(proven, ..)| proven.is_ok()));
    assert_eq!(stop(1).0, Err(ConnectionLimitError::Address(1)));
    let operator = stop(2);
    assert_eq!(operator.0, Ok(()));
    drop(viewer);
    assert_eq!(stop(1).0, Ok(()));
}

proptest! {
    #[test]
    fn whatever_happens_the_bounds_hold_and_the_books_balance(
        steps in prop::collection::vec((0_u8..7, 0_u8..5, 0_usize..12), 1..200),
    ) {
        let connections = Connections::new(FEW);
        let mut slots: Vec<(Arc<Slot>, Vec<RequestGuard>)> = Vec::new();
        for (what, from, which) in steps {
            let chosen = which % slots.len().max(1);
            match what {
                0 => slots.extend(open(&connections, from).map(|(slot, _)| (slot, Vec::new()))),
                1 if !slots.is_empty() => {
                    let at_work = slots[chosen].0.work();
                    slots[chosen].1.push(at_work);
                }
                2 if !slots.is_empty() => drop(slots[chosen].1.pop()),
                3 if !slots.is_empty() => drop(slots.remove(chosen)),
                4 if !slots.is_empty() => {
                    let client = (from > 2).then(|| address(from));
                    let (at_work, _) = slots[chosen].0.begin(client);
                    slots[chosen].1.push(at_work);
                }
                5 | 6 if !slots.is_empty() && !slots[chosen].1.is_empty() => {
                    let purpose = if what == 5 { Purpose::Other } else { Purpose::Stop };
                    let _full = slots[chosen].0.prove(token(from.into()), purpose);
                }
                _ => {}
            }
            let table = connections.lock();
            prop_assert!(table.entries.len() <= FEW.all);
            prop_assert!(table.unproven.len() <= FEW.unproven);
            let of_addresses = &table.proven_per_address;
            prop_assert!(of_addresses.values().all(|&count| count <= FEW.per_address));
            prop_assert_eq!(of_addresses.values().sum::<usize>(), table.proven);
            let unproven: usize = table.unproven_per_address.values().sum();
            prop_assert_eq!(unproven, table.unproven.len());
            let in_phase = |phase| {
                table.entries.values().filter(|entry| entry.phase == phase).count()
            };
            prop_assert_eq!(in_phase(Phase::Idle), table.idle.len());
            prop_assert_eq!(in_phase(Phase::Idle) + in_phase(Phase::Busy), table.proven);
            prop_assert_eq!(in_phase(Phase::Stopping), table.stopping);
            let identified = table.entries.values().filter(|entry| entry.identity.is_some());
            let of_identities = table.proven_per_identity.values().sum::<usize>();
            let stopping = table.stopping_per_identity.values().sum::<usize>();
            prop_assert_eq!(of_identities + stopping, identified.count());
        }
        drop(slots);
        let table = connections.lock();
        prop_assert!(table.entries.is_empty() && table.idle.is_empty());
        prop_assert!(table.unproven.is_empty() && table.unproven_per_address.is_empty());
        prop_assert!(table.proven_per_address.is_empty());
        prop_assert!(table.proven_per_identity.is_empty() && table.stopping_per_identity.is_empty());
        prop_assert_eq!(table.proven + table.stopping, 0);
    }
}

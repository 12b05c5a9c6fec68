use super::*;

/// Settings without any topic.
pub(crate) fn settings() -> Ros2Settings {
    settings_of(&RobotModel::yi2007(), None)
}

fn topic(name: &str, kind: &str) -> Topic {
    Topic {
        name: name.to_owned(),
        message_type: kind.to_owned(),
        encoding: CDR.to_owned(),
        count: 2,
        first_ns: 0,
        last_ns: 1,
    }
}

/// Chooses among topics that have no joints to be read.
fn chosen(topics: Vec<Topic>, requested: &RequestedTopics) -> Result<Mapping, MappingError> {
    let contents = Contents {
        topics,
        torn: Vec::new(),
    };
    let robot = Robot {
        model: RobotModel::yi2007(),
        prior: tread_control::estimation::EstimatorPrior::default(),
        settings: None,
        rate_hz: 100.0,
    };
    let recording = Recording::open(&[]).unwrap();
    choose(&recording, &contents, &robot, requested)
}

#[test]
fn what_is_missing_or_ambiguous_is_said_with_the_topics_that_there_are() {
    let wheels = || topic("/joint_states", JOINT_STATE);
    let imus = || vec![topic("/a/imu", IMU), topic("/b/imu", IMU), wheels()];
    let none = RequestedTopics::default();
    let refused =
        |topics, requested: &RequestedTopics| chosen(topics, requested).unwrap_err().to_string();
    let two = refused(imus(), &none);
    assert!(
        two.contains("--imu") && two.contains("/b/imu  sensor_msgs/msg/Imu"),
        "{two}"
    );
    let requested = RequestedTopics {
        imu: Some("b/imu".to_owned()),
        ..RequestedTopics::default()
    };
    // The topics are found, and the next question is which joints are whose.
    let next = refused(imus(), &requested);
    assert!(next.contains("--joints"), "{next}");
    let requested = RequestedTopics {
        imu: Some("/joint_states".to_owned()),
        ..RequestedTopics::default()
    };
    let wrong = refused(imus(), &requested);
    assert!(
        wrong.contains(JOINT_STATE) && wrong.contains("is needed"),
        "{wrong}"
    );
    let requested = RequestedTopics {
        wheels: Some("/wheels".to_owned()),
        ..RequestedTopics::default()
    };
    assert!(refused(imus(), &requested).contains("there is no topic `/wheels`"));
    assert!(refused(vec![wheels()], &none).contains("yaw rate"));
    assert!(refused(vec![topic("/imu", IMU)], &none).contains("wheel speeds"));
    let odometry = || topic("/odom", ODOMETRY);
    assert!(refused(vec![odometry()], &none).contains("θ needs a gyro"));
    let both = || vec![odometry(), topic("/imu", IMU)];
    assert!(refused(both(), &none).contains("--odometry-track-m"));
    let requested = RequestedTopics {
        odometry_track_m: Some(0.8),
        ..RequestedTopics::default()
    };
    let mapping = chosen(both(), &requested).unwrap();
    assert_eq!(mapping.topics(), ["/imu", "/odom"]);
    assert!((mapping.settings.command.base_track_m - 0.8).abs() < 1.0e-12);
}

#[test]
fn several_poses_are_left_out_and_that_is_said() {
    let topics = vec![
        topic("/imu", IMU),
        topic("/odom", ODOMETRY),
        topic("/amcl", COVARIANT_POSE),
        topic("/mocap", POSE),
    ];
    let mut requested = RequestedTopics {
        odometry_track_m: Some(0.8),
        ..RequestedTopics::default()
    };
    let mapping = chosen(topics.clone(), &requested).unwrap();
    assert_eq!(mapping.pose, None);
    assert!(
        mapping.notices[0].contains("/amcl, /mocap"),
        "{:?}",
        mapping.notices
    );
    requested.pose = Some("/mocap".to_owned());
    let mapping = chosen(topics, &requested).unwrap();
    assert_eq!(mapping.pose, Some(("/mocap".to_owned(), POSE)));
}

#[test]
fn a_list_says_what_is_missing() {
    let of = |topics| {
        missing(&Contents {
            topics,
            torn: Vec::new(),
        })
    };
    assert_eq!(of(Vec::new()).len(), 2);
    assert!(of(vec![topic("/odom", ODOMETRY)])[0].contains("--odometry-track-m"));
    let enough = vec![topic("/imu", IMU), topic("/joints", JOINT_STATE)];
    assert_eq!(of(enough), Vec::<String>::new());
}

fn owned(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

#[test]
fn sides_follow_from_the_words_in_names_and_are_not_guessed() {
    let husky = owned(&[
        "front_left_wheel",
        "front_right_wheel",
        "rear_left_wheel",
        "rear_right_wheel",
    ]);
    let sides = sides_of(&husky).unwrap();
    assert_eq!(sides.left, owned(&["front_left_wheel", "rear_left_wheel"]));
    assert_eq!(
        sides.right,
        owned(&["front_right_wheel", "rear_right_wheel"])
    );
    let short = sides_of(&owned(&["wheel_l", "wheel_r", "lidar_spin"])).unwrap();
    assert_eq!(
        (short.left, short.right),
        (owned(&["wheel_l"]), owned(&["wheel_r"]))
    );
    assert_eq!(sides_of(&owned(&["wheel_1", "wheel_2"])), None);
    assert_eq!(sides_of(&owned(&["left_a", "left_b", "right_a"])), None);
}

#[test]
fn joints_are_parsed_with_a_slash_between_the_sides() {
    let names: JointNames = "fl, rl/fr,rr".parse().unwrap();
    assert_eq!(
        (names.left, names.right),
        (owned(&["fl", "rl"]), owned(&["fr", "rr"]))
    );
    for bad in ["fl,fr", "/fr", "a/", "a,b,c,d,e,f,g,h,i/j"] {
        assert!(bad.parse::<JointNames>().is_err(), "{bad}");
    }
}

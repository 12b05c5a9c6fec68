use std::collections::BTreeMap;

use mcap::records::MessageHeader;
use mcap::write::Writer;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{ConnectOptions as _, Connection as _};

use super::*;

/// A topic and its type.
type Declared = (&'static str, &'static str);
/// The topic's index, the time of recording, and the bytes.
type Written = (usize, i64, Vec<u8>);

const TOPICS: [Declared; 3] = [
    ("/joint_states", "sensor_msgs/msg/JointState"),
    ("/imu", "sensor_msgs/msg/Imu"),
    ("/silent", "std_msgs/msg/String"),
];

fn some_messages() -> Vec<Written> {
    let message = |index: i64| {
        let topic = usize::from(index % 2 == 0);
        let bytes = index.to_le_bytes().repeat(4);
        (topic, 1_000_000_000 + 10_000_000 * index, bytes)
    };
    (0..200).map(message).collect()
}

fn mcap(file: &Path, encoding: &str, messages: &[Written]) {
    let mut writer = Writer::new(File::create(file).unwrap()).unwrap();
    let ids = TOPICS.map(|(topic, kind)| {
        let schema = writer.add_schema(kind, "ros2msg", b"").unwrap();
        writer
            .add_channel(schema, topic, encoding, &BTreeMap::new())
            .unwrap()
    });
    for (topic, logged_ns, bytes) in messages {
        let time = u64::try_from(*logged_ns).unwrap();
        let header = MessageHeader {
            channel_id: ids[*topic],
            sequence: 0,
            log_time: time,
            publish_time: time,
        };
        writer.write_to_known_channel(&header, bytes).unwrap();
        // A chunk for each few messages, so that a torn file has whole ones.
        if logged_ns % 100_000_000 == 0 {
            writer.flush().unwrap();
        }
    }
    writer.finish().unwrap();
}

fn bag(file: &Path, messages: &[Written]) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let options = SqliteConnectOptions::new().filename(file).create_if_missing(true);
        let mut connection: SqliteConnection = options.connect().await.unwrap();
        sqlx::raw_sql(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, \
             serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL); \
             CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, \
             timestamp INTEGER NOT NULL, data BLOB NOT NULL);",
        )
        .execute(&mut connection)
        .await
        .unwrap();
        for (topic, kind) in TOPICS {
            sqlx::query("INSERT INTO topics(name, type, serialization_format, offered_qos_profiles) VALUES (?, ?, 'cdr', '')")
                .bind(topic)
                .bind(kind)
                .execute(&mut connection)
                .await
                .unwrap();
        }
        for (topic, logged_ns, bytes) in messages {
            sqlx::query("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)")
                .bind(i64::try_from(topic + 1).unwrap())
                .bind(logged_ns)
                .bind(bytes)
                .execute(&mut connection)
                .await
                .unwrap();
        }
        connection.close().await.unwrap();
    });
}

/// A message that was read: topic, time of recording, and bytes.
type Found = (String, i64, Vec<u8>);

fn all(recording: &Recording, topics: &[&str]) -> (Vec<Found>, Vec<String>) {
    let mut read = Vec::new();
    let torn = recording.read(topics, &mut |message| {
        read.push((
            message.topic.to_owned(),
            message.logged_ns,
            message.bytes.to_vec(),
        ));
        ControlFlow::Continue(())
    });
    (read, torn.unwrap())
}

#[test]
fn both_formats_give_the_same_topics_and_messages() {
    let folder = tempfile::tempdir().unwrap();
    let (one, other) = (
        folder.path().join("a.mcap"),
        folder.path().join("bag/a_0.db3"),
    );
    std::fs::create_dir(folder.path().join("bag")).unwrap();
    mcap(&one, CDR, &some_messages());
    bag(&other, &some_messages());
    // A folder of rosbag2 has other files beside its databases.
    std::fs::write(folder.path().join("bag/metadata.yaml"), "x").unwrap();
    let one = Recording::open(&[one]).unwrap();
    let other = Recording::open(&[folder.path().join("bag")]).unwrap();
    let contents = one.contents().unwrap();
    assert_eq!(contents, other.contents().unwrap());
    let names: Vec<&str> = contents
        .topics
        .iter()
        .map(|topic| topic.name.as_str())
        .collect();
    assert_eq!(names, ["/imu", "/joint_states"]);
    let imu = &contents.topics[0];
    assert_eq!(
        (imu.count, imu.message_type.as_str()),
        (100, "sensor_msgs/msg/Imu")
    );
    assert!((imu.rate_hz().unwrap() - 50.0).abs() < 1.0e-9);
    assert!(
        contents
            .lines()
            .contains("/imu  sensor_msgs/msg/Imu, 100 messages, 50.0 Hz")
    );
    let (read, torn) = all(&one, &["/imu", "/joint_states"]);
    assert_eq!((read.len(), torn.len()), (200, 0));
    assert_eq!(read, all(&other, &["/imu", "/joint_states"]).0);
    assert_eq!(all(&other, &["/imu"]).0.len(), 100);
    assert_eq!(all(&one, &["/imu"]).0, all(&other, &["/imu"]).0);
}

#[test]
fn reading_ends_where_enough_was_read() {
    let folder = tempfile::tempdir().unwrap();
    let (one, other) = (folder.path().join("a.mcap"), folder.path().join("a.db3"));
    mcap(&one, CDR, &some_messages());
    bag(&other, &some_messages());
    let both = Recording::open(&[one, other]).unwrap();
    let mut count = 0;
    let torn = both.read(&["/imu"], &mut |_| {
        count += 1;
        if count < 7 {
            ControlFlow::Continue(())
        } else {
            ControlFlow::Break(())
        }
    });
    assert_eq!((count, torn.unwrap().len()), (7, 0));
    // Files of one recording are counted together.
    assert_eq!(both.contents().unwrap().topics[0].count, 200);
}

#[test]
fn a_torn_file_is_read_up_to_where_it_is_torn() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.mcap");
    mcap(&file, CDR, &some_messages());
    let whole = std::fs::read(&file).unwrap();
    std::fs::write(&file, &whole[..whole.len() / 2]).unwrap();
    let recording = Recording::open(std::slice::from_ref(&file)).unwrap();
    let contents = recording.contents().unwrap();
    assert!(contents.torn[0].contains("a.mcap"), "{:?}", contents.torn);
    let (read, torn) = all(&recording, &["/imu", "/joint_states"]);
    assert!((20..180).contains(&read.len()), "{}", read.len());
    assert_eq!(torn.len(), 1);
    // Without a whole chunk there is nothing to be read.
    std::fs::write(&file, &whole[..100]).unwrap();
    let refused = recording.contents().unwrap_err().to_string();
    assert!(
        refused.contains("torn before its first message"),
        "{refused}"
    );
    let database = folder.path().join("a.db3");
    bag(&database, &some_messages());
    let whole = std::fs::read(&database).unwrap();
    std::fs::write(&database, &whole[..whole.len() / 2]).unwrap();
    let refused = Recording::open(&[database])
        .unwrap()
        .contents()
        .unwrap_err()
        .to_string();
    assert!(
        refused.contains("a.db3") && refused.contains("malformed"),
        "{refused}"
    );
}

#[test]
fn what_is_no_recording_is_named_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let named = |name: &str, bytes: &[u8]| {
        let file = folder.path().join(name);
        std::fs::write(&file, bytes).unwrap();
        Recording::open(&[file]).unwrap_err().to_string()
    };
    let ros1 = named("a.bag", b"#ROSBAG V2.0\n........");
    assert!(
        ros1.contains("ROS 1") && ros1.contains("rosbags-convert"),
        "{ros1}"
    );
    assert!(named("a.db3.zstd", &[0x28, 0xb5, 0x2f, 0xfd, 0]).contains("zstd -d"));
    assert!(named("a.txt", b"hello").contains("neither"));
    assert!(named("empty", b"").contains("neither"));
    let missing = Recording::open(&[folder.path().join("none.mcap")]).unwrap_err();
    assert!(missing.to_string().contains("none.mcap"), "{missing}");
    let bare = tempfile::tempdir().unwrap();
    let refused = Recording::open(&[bare.path().to_owned()])
        .unwrap_err()
        .to_string();
    assert!(refused.contains("`.mcap` or `.db3`"), "{refused}");
    let file = folder.path().join("ros1.mcap");
    mcap(&file, "ros1", &some_messages());
    let refused = Recording::open(&[file])
        .unwrap()
        .contents()
        .unwrap_err()
        .to_string();
    assert!(refused.contains("ROS 1"), "{refused}");
    let file = folder.path().join("empty.mcap");
    mcap(&file, CDR, &[]);
    let refused = Recording::open(&[file])
        .unwrap()
        .contents()
        .unwrap_err()
        .to_string();
    assert!(refused.contains("no messages"), "{refused}");
    let file = folder.path().join("other.db3");
    bag(&file, &[]);
    let refused = Recording::open(&[file])
        .unwrap()
        .contents()
        .unwrap_err()
        .to_string();
    assert!(refused.contains("no messages"), "{refused}");
}

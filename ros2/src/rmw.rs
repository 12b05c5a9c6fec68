//! What `rmw_zenoh_cpp` puts around messages: key expressions, attachments, liveliness tokens.
//!
//! A topic's key names domain, topic, type and the hash of the type; Humble knows no hashes and
//! writes [`NO_HASH`]. Each message carries an attachment, without which `rmw_zenoh_cpp` drops it. Nodes
//! and their endpoints are seen in the ROS graph by liveliness tokens; the hash of an endpoint's
//! token names it in its attachments.

use std::fmt;

use twox_hash::XxHash3_128;

use crate::messages::MessageType;
use crate::names::Name;

/// What stands for a type's hash before Iron.
pub const NO_HASH: &str = "TypeHashNotSupported";
/// Bytes of an attachment.
pub const ATTACHMENT_BYTES: usize = 33;
/// Bytes of an endpoint's name.
pub const GID_BYTES: usize = 16;
/// History that `rmw_zenoh_cpp` takes for the default and does not write.
const DEPTH_DEFAULT: u32 = 42;

/// A generation of ROS 2, by what its keys hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Generation {
    /// Humble: types have no hashes.
    Humble,
    /// Iron, Jazzy, Kilted and later.
    #[default]
    Hashed,
}

impl Generation {
    /// What stands in a key for the type's hash.
    pub fn hash(self, message_type: &MessageType) -> &'static str {
        match self {
            Self::Humble => NO_HASH,
            Self::Hashed => message_type.hash,
        }
    }
}

/// A type as `rmw_zenoh_cpp` writes it.
fn dds_type(message_type: &MessageType) -> String {
    format!(
        "{}::msg::dds_::{}_",
        message_type.package, message_type.name
    )
}

/// The key on which a topic is published.
pub fn topic_key(
    domain: u32,
    topic: &Name,
    message_type: &MessageType,
    generation: Generation,
) -> String {
    let (topic, hash) = (topic.as_str(), generation.hash(message_type));
    format!("{domain}/{topic}/{}/{hash}", dds_type(message_type))
}

/// The keys of a topic whatever its type, so that a wrong one is seen.
pub fn any_type_key(domain: u32, topic: &Name) -> String {
    format!("{domain}/{}/*/*", topic.as_str())
}

/// How a key differs from the one that was expected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeyMismatch {
    /// Another type.
    Type,
    /// The same type, defined otherwise.
    Hash,
}

/// Looks whether a topic's key is of the type.
///
/// # Errors
/// [`KeyMismatch`].
pub fn check_key(
    key: &str,
    message_type: &MessageType,
    generation: Generation,
) -> Result<(), KeyMismatch> {
    let mut from_end = key.rsplit('/');
    let (hash, name) = (from_end.next(), from_end.next());
    let inner = name.and_then(|name| {
        let name = name.strip_prefix(message_type.package)?;
        name.strip_prefix("::msg::dds_::")?.strip_suffix('_')
    });
    if inner != Some(message_type.name) {
        Err(KeyMismatch::Type)
    } else if hash != Some(generation.hash(message_type)) {
        Err(KeyMismatch::Hash)
    } else {
        Ok(())
    }
}

/// What comes with each message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attachment {
    /// The message's number, from one on.
    pub sequence: i64,
    /// When it was written, nanoseconds of the writer's clock since its epoch.
    pub source_time_ns: i64,
    /// Who wrote it.
    pub gid: [u8; GID_BYTES],
}

impl Attachment {
    /// As it is sent.
    pub fn to_bytes(self) -> [u8; ATTACHMENT_BYTES] {
        let mut bytes = [0; ATTACHMENT_BYTES];
        bytes[..8].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.source_time_ns.to_le_bytes());
        // The length of what follows, as zenoh's serialisation writes it.
        bytes[16] = 16;
        bytes[17..].copy_from_slice(&self.gid);
        bytes
    }

    /// Reads one; none where there is no such.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let bytes: &[u8; ATTACHMENT_BYTES] = bytes.try_into().ok()?;
        let (sequence, rest) = bytes.split_first_chunk()?;
        let (source_time_ns, rest) = rest.split_first_chunk()?;
        let (length, gid) = rest.split_first()?;
        if usize::from(*length) != GID_BYTES {
            return None;
        }
        Some(Self {
            sequence: i64::from_le_bytes(*sequence),
            source_time_ns: i64::from_le_bytes(*source_time_ns),
            gid: gid.try_into().ok()?,
        })
    }
}

/// The name of an endpoint in its attachments.
pub fn gid(token: &str) -> [u8; GID_BYTES] {
    XxHash3_128::oneshot(token.as_bytes()).to_le_bytes()
}

/// How an endpoint wants its messages carried; only what differs from ROS's default is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quality {
    /// Lost messages are sent again.
    pub is_reliable: bool,
    /// Messages that are kept.
    pub depth: u32,
}

impl fmt::Display for Quality {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.is_reliable {
            formatter.write_str("2")?;
        }
        formatter.write_str("::,")?;
        if self.depth != 0 && self.depth != DEPTH_DEFAULT {
            write!(formatter, "{}", self.depth)?;
        }
        formatter.write_str(":,:,:,,")
    }
}

/// A node in the graph.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    /// The domain.
    pub domain: u32,
    /// The zenoh session, in its own spelling.
    pub session: String,
    /// Which node of the session.
    pub number: u32,
    /// Its namespace.
    pub namespace: Name,
    /// Its name.
    pub name: Name,
}

/// What an endpoint does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// It publishes.
    Publisher,
    /// It subscribes.
    Subscriber,
}

/// An endpoint of a node.
#[derive(Debug, Clone, Copy)]
pub struct Endpoint<'a> {
    /// What it does.
    pub role: Role,
    /// Which entity of the session; no other has the number.
    pub number: u32,
    /// The topic.
    pub topic: &'a Name,
    /// Of which type.
    pub message_type: &'a MessageType,
    /// Whether types have hashes.
    pub generation: Generation,
    /// How messages are carried.
    pub quality: Quality,
}

/// A name in a token: slashes would part it.
fn mangled(name: &Name) -> String {
    format!("%{}", name.as_str().replace('/', "%"))
}

impl Node {
    fn head(&self) -> String {
        format!("@ros2_lv/{}/{}/{}", self.domain, self.session, self.number)
    }

    /// Enclave, namespace and name. An enclave is a robot's set of keys for DDS; there is none.
    fn tail(&self) -> String {
        format!("%/{}/{}", mangled(&self.namespace), self.name.as_str())
    }

    /// The node's token.
    pub fn token(&self) -> String {
        format!("{}/{}/NN/{}", self.head(), self.number, self.tail())
    }

    /// The token of one of its endpoints.
    pub fn endpoint_token(&self, endpoint: &Endpoint<'_>) -> String {
        let role = match endpoint.role {
            Role::Publisher => "MP",
            Role::Subscriber => "MS",
        };
        format!(
            "{}/{}/{role}/{}/{}/{}/{}/{}",
            self.head(),
            endpoint.number,
            self.tail(),
            mangled(endpoint.topic),
            dds_type(endpoint.message_type),
            endpoint.generation.hash(endpoint.message_type),
            endpoint.quality,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{Message, Odometry, Twist};

    const STRING: MessageType = MessageType {
        package: "std_msgs",
        name: "String",
        hash: "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    };

    fn topic(text: &str) -> Name {
        Name::topic(text, &Name::default()).unwrap()
    }

    /// The example of `rmw_zenoh_cpp`'s own description of its design.
    fn listener() -> Node {
        Node {
            domain: 2,
            session: "aac3178e146ba6f1fc6e6a4085e77f21".to_owned(),
            number: 0,
            namespace: Name::default(),
            name: Name::node("listener").unwrap(),
        }
    }

    #[test]
    fn tokens_are_those_of_the_design_of_rmw_zenoh() {
        let node = listener();
        assert_eq!(
            node.token(),
            "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
        );
        let chatter = topic("/chatter");
        let endpoint = Endpoint {
            role: Role::Subscriber,
            number: 10,
            topic: &chatter,
            message_type: &STRING,
            generation: Generation::Hashed,
            quality: Quality {
                is_reliable: true,
                depth: 10,
            },
        };
        assert_eq!(
            node.endpoint_token(&endpoint),
            "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/\
             std_msgs::msg::dds_::String_/\
             RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,10:,:,:,,"
        );
    }

    #[test]
    fn a_name_with_slashes_is_one_part_of_a_token() {
        let node = Node {
            namespace: Name::namespace("/fleet/robot7").unwrap(),
            ..listener()
        };
        assert!(node.token().ends_with("/NN/%/%fleet%robot7/listener"));
        let quality = Quality {
            is_reliable: false,
            depth: 5,
        };
        assert_eq!(quality.to_string(), "2::,5:,:,:,,");
        let endpoint = Endpoint {
            role: Role::Publisher,
            number: 3,
            topic: &topic("/fleet/robot7/cmd_vel"),
            message_type: &Twist::TYPE,
            generation: Generation::Humble,
            quality,
        };
        assert!(node.endpoint_token(&endpoint).ends_with(
            "/0/3/MP/%/%fleet%robot7/listener/%fleet%robot7%cmd_vel/\
             geometry_msgs::msg::dds_::Twist_/TypeHashNotSupported/2::,5:,:,:,,"
        ));
    }

    #[test]
    fn keys_name_domain_topic_type_and_hash() {
        let odom = topic("/robot7/odom");
        assert_eq!(
            topic_key(0, &odom, &Odometry::TYPE, Generation::Hashed),
            "0/robot7/odom/nav_msgs::msg::dds_::Odometry_/\
             RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
        );
        let humble = topic_key(30, &odom, &Odometry::TYPE, Generation::Humble);
        assert_eq!(
            humble,
            "30/robot7/odom/nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported"
        );
        assert_eq!(any_type_key(30, &odom), "30/robot7/odom/*/*");
    }

    #[test]
    fn a_key_of_another_type_or_definition_is_seen() {
        let odom = topic("odom");
        let hashed = topic_key(0, &odom, &Odometry::TYPE, Generation::Hashed);
        let check = |key: &str| check_key(key, &Odometry::TYPE, Generation::Hashed);
        assert_eq!(check(&hashed), Ok(()));
        let humble = topic_key(0, &odom, &Odometry::TYPE, Generation::Humble);
        assert_eq!(check(&humble), Err(KeyMismatch::Hash));
        let twist = topic_key(0, &odom, &Twist::TYPE, Generation::Hashed);
        assert_eq!(check(&twist), Err(KeyMismatch::Type));
        for other in [
            "odom",
            "",
            "0/odom/nav_msgs::msg::dds_::Odometry_Odometry_/x",
        ] {
            assert_eq!(check(other), Err(KeyMismatch::Type), "{other}");
        }
    }

    #[test]
    fn an_attachment_is_what_zenoh_serialises() {
        let attachment = Attachment {
            sequence: 0x0102,
            source_time_ns: 1_700_000_000_123_456_789,
            gid: *b"abcdefghijklmnop",
        };
        let bytes = attachment.to_bytes();
        assert_eq!(bytes[..8], [2, 1, 0, 0, 0, 0, 0, 0]);
        assert_eq!(bytes[16], 0x10);
        assert_eq!(Attachment::from_bytes(&bytes), Some(attachment));
        assert_eq!(Attachment::from_bytes(&bytes[..32]), None);
        let mut longer = bytes.to_vec();
        longer.push(0);
        assert_eq!(Attachment::from_bytes(&longer), None);
        longer.pop();
        longer[16] = 15;
        assert_eq!(Attachment::from_bytes(&longer), None);
    }
}

//! The robot's own bus: a second zenoh session, on this machine alone.
//!
//! It is separate from the fleet's session, so messages of the bus stay on the robot. One thread
//! opens the session, retrying until it succeeds, announces the agent's node in the ROS graph,
//! subscribes, and writes the loop's commands; a second one publishes the agent's state.

use std::sync::Arc;
use std::time::Duration;

use tracing::{debug, info, warn};
use tread_control::measured::WheelSpeeds;
use tread_ros2::messages::MessageType;
use tread_ros2::names::Name;
use tread_ros2::rmw::{self, Attachment, Endpoint, Generation, Node, Quality, Role};
use zenoh::Wait as _;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::Locality;

use super::bus_config::session_config;
use super::command;
use super::command_cell::{COMMAND_SILENCE_MAX, CommandCell};
use super::command_watch::CommandWatch;
use super::published_topics::{CHECK_EVERY, PublishedTopic, StatePublisher};
use super::refusal::Counts;
use super::settings::{OutwardSettings, Ros2Settings, Scheme};
use super::topic_receiver::{Numbering, TopicReceiver};
use crate::clock::SharedClock;
use crate::fleet::{LinkError, zenoh_failed};

/// Pause after a failed series of attempts.
const OPEN_REST: Duration = Duration::from_millis(100);
/// Largest payload that is read, bytes.
const PAYLOAD_BYTES_MAX: usize = tread_ros2::cdr::MESSAGE_BYTES_MAX;
/// Number of the agent's only node.
const NODE_NUMBER: u32 = 0;

/// The bus's session, its receivers and its command cell.
#[derive(Debug)]
pub struct Bus {
    config: zenoh::Config,
    settings: Arc<Ros2Settings>,
    pub(super) receivers: Vec<Arc<TopicReceiver>>,
    command_cell: Arc<CommandCell>,
    clock: SharedClock,
    outward: Option<Box<dyn StatePublisher>>,
    command_watch: Arc<CommandWatch>,
}

/// Declarations that live as long as the session.
#[derive(Debug)]
struct Declarations {
    commands: Writer,
    outward_topics: Vec<(PublishedTopic, Writer)>,
    _tokens: Vec<LivelinessToken>,
}

/// Writer of one topic.
#[derive(Debug)]
struct Writer {
    publisher: Publisher<'static>,
    /// Writer's identifier in its attachments; `None` where messages have no attachment.
    gid: Option<[u8; rmw::GID_BYTES]>,
    numbering: Numbering,
}

impl Writer {
    fn put(&self, bytes: &[u8], wall_ns: i64) -> zenoh::Result<()> {
        let put = self.publisher.put(bytes);
        match self.gid {
            None => put.wait(),
            Some(gid) => {
                let attachment = Attachment {
                    sequence: self.numbering.next(),
                    source_time_ns: wall_ns,
                    gid,
                };
                put.attachment(attachment.to_bytes().as_slice()).wait()
            }
        }
    }
}

/// A topic that the agent reads or writes.
struct Topic<'a> {
    role: Role,
    number: u32,
    name: &'a Name,
    message_type: &'a MessageType,
    quality: Quality,
}

impl Bus {
    /// Creates a bus without opening its session.
    ///
    /// # Errors
    /// [`LinkError::Endpoint`] for an invalid endpoint.
    pub fn new(
        settings: Arc<Ros2Settings>,
        receivers: Vec<TopicReceiver>,
        command_cell: Arc<CommandCell>,
        clock: SharedClock,
        counts: Arc<Counts>,
    ) -> Result<Self, LinkError> {
        let command_type = command::message_type(settings.command.kind);
        Ok(Self {
            config: session_config(&settings.bus)?,
            command_watch: Arc::new(CommandWatch::new(settings.bus.scheme, command_type, counts)),
            settings,
            receivers: receivers.into_iter().map(Arc::new).collect(),
            command_cell,
            clock,
            outward: None,
        })
    }

    /// Returns the settings of the topics on which the agent publishes its state.
    pub(crate) fn outward_settings(&self) -> Option<&OutwardSettings> {
        self.settings.outward.as_ref()
    }

    /// Publishes the messages of this source.
    pub(crate) fn publish(&mut self, source: Box<dyn StatePublisher>) {
        self.outward = Some(source);
    }

    /// Runs the session until the loop closes the command cell. For a thread of its own.
    pub fn run(mut self) {
        self.command_cell.register_thread();
        let (mut outward, endpoint) = (self.outward.take(), &self.settings.bus.endpoint);
        while let Some(session) = self.open() {
            info!(endpoint, "on the robot's bus at `{endpoint}`");
            match self.declare(&session, outward.is_some()) {
                Ok(declared) => self.run_publishers(&declared, outward.as_deref_mut()),
                Err(cause) => {
                    let cause = &cause as &dyn std::error::Error;
                    warn!(error = cause, "the robot's bus cannot be used");
                    std::thread::sleep(OPEN_REST);
                }
            }
            let _ = session.close().wait();
        }
    }

    fn open(&self) -> Option<zenoh::Session> {
        let mut is_reported = false;
        while !self.command_cell.is_closed() {
            match zenoh::open(self.config.clone()).wait() {
                Ok(session) => return Some(session),
                Err(cause) if is_reported => debug!("the robot's bus is not reached: {cause}"),
                Err(cause) => {
                    let endpoint = &self.settings.bus.endpoint;
                    warn!("the robot's bus at `{endpoint}` is not reached yet: {cause}");
                    is_reported = true;
                }
            }
            std::thread::sleep(OPEN_REST);
        }
        None
    }

    fn generation(&self) -> Option<Generation> {
        match self.settings.bus.scheme {
            Scheme::RmwZenoh(generation) => Some(generation),
            Scheme::Ros2Dds => None,
        }
    }

    fn declare(
        &self,
        session: &zenoh::Session,
        publishes_state: bool,
    ) -> Result<Declarations, LinkError> {
        let bus = &self.settings.bus;
        let node = Node {
            domain: bus.domain,
            session: session.zid().to_string(),
            number: NODE_NUMBER,
            namespace: bus.namespace.clone(),
            name: bus.node.clone(),
        };
        let mut tokens = Vec::new();
        if self.generation().is_some() {
            tokens.push(declare_token(session, node.token())?);
        }
        let mut number = NODE_NUMBER;
        for receiver in &self.receivers {
            let Some(name) = receiver.topic() else {
                continue;
            };
            number += 1;
            let message_type = receiver.message_type();
            let topic = Topic {
                role: Role::Subscriber,
                number,
                name,
                message_type: &message_type,
                quality: Quality {
                    is_reliable: false,
                    depth: 5,
                },
            };
            if let Some(token) = self.token(&node, &topic) {
                tokens.push(declare_token(session, token)?);
            }
            self.listen(session, receiver, name)?;
        }
        let command = &self.settings.command;
        let message_type = command::message_type(command.kind);
        number += 1;
        let topic = Topic {
            role: Role::Publisher,
            number,
            name: &command.topic,
            message_type: &message_type,
            quality: Quality {
                is_reliable: true,
                depth: 1,
            },
        };
        let commands = self.writer(session, &node, &topic, Priority::RealTime, &mut tokens)?;
        self.command_watch.write_as(commands.gid);
        self.watch_commands(session)?;
        let mut outward_topics = Vec::new();
        if let Some(outward) = self.settings.outward.as_ref().filter(|_| publishes_state) {
            for outward_topic in PublishedTopic::ALL {
                number += 1;
                let message_type = outward_topic.message_type();
                let topic = Topic {
                    role: Role::Publisher,
                    number,
                    name: outward_topic.topic(outward),
                    message_type: &message_type,
                    quality: Quality {
                        is_reliable: true,
                        depth: 1,
                    },
                };
                // A path of hundreds of points must not delay a command or a sensor's message.
                let writer =
                    self.writer(session, &node, &topic, Priority::Background, &mut tokens)?;
                outward_topics.push((outward_topic, writer));
            }
        }
        Ok(Declarations {
            commands,
            outward_topics,
            _tokens: tokens,
        })
    }

    /// Announces a topic that is written, and declares its publisher.
    fn writer(
        &self,
        session: &zenoh::Session,
        node: &Node,
        topic: &Topic<'_>,
        priority: Priority,
        tokens: &mut Vec<LivelinessToken>,
    ) -> Result<Writer, LinkError> {
        let bus = &self.settings.bus;
        let token = self.token(node, topic);
        let key = match self.generation() {
            Some(generation) => {
                rmw::topic_key(bus.domain, topic.name, topic.message_type, generation)
            }
            None => topic.name.bridge_key(&bus.namespace),
        };
        let publisher = session
            .declare_publisher(key)
            .congestion_control(CongestionControl::Drop)
            .priority(priority)
            .express(priority == Priority::RealTime)
            .wait()
            .map_err(zenoh_failed("declare a topic"))?;
        let gid = token.as_deref().map(rmw::gid);
        if let Some(token) = token {
            tokens.push(declare_token(session, token)?);
        }
        Ok(Writer {
            publisher,
            gid,
            numbering: Numbering::default(),
        })
    }

    fn token(&self, node: &Node, topic: &Topic<'_>) -> Option<String> {
        let endpoint = Endpoint {
            role: topic.role,
            number: topic.number,
            topic: topic.name,
            message_type: topic.message_type,
            generation: self.generation()?,
            quality: topic.quality,
        };
        Some(node.endpoint_token(&endpoint))
    }

    fn listen(
        &self,
        session: &zenoh::Session,
        receiver: &Arc<TopicReceiver>,
        topic: &Name,
    ) -> Result<(), LinkError> {
        let receiver = Arc::clone(receiver);
        session
            .declare_subscriber(self.subscription_key(topic))
            .callback(move |sample| {
                deliver(&sample, |key, with, said| receiver.take(key, with, said));
            })
            .background()
            .wait()
            .map_err(zenoh_failed("listen to a topic"))
    }

    fn subscription_key(&self, topic: &Name) -> String {
        let bus = &self.settings.bus;
        match self.generation() {
            Some(_) => rmw::any_type_key(bus.domain, topic),
            None => topic.bridge_key(&bus.namespace),
        }
    }

    /// Subscribes to the command topic to detect other writers, unannounced in the ROS graph.
    fn watch_commands(&self, session: &zenoh::Session) -> Result<(), LinkError> {
        let watch = Arc::clone(&self.command_watch);
        session
            .declare_subscriber(self.subscription_key(&self.settings.command.topic))
            .callback(move |sample| {
                deliver(&sample, |key, with, said| watch.receive(key, with, said));
            })
            .allowed_origin(Locality::Remote)
            .background()
            .wait()
            .map_err(zenoh_failed("listen to the command topic"))
    }

    /// Writes commands, and publishes the agent's state on a thread of its own, so that no command
    /// waits for a path of hundreds of points.
    fn run_publishers(
        &self,
        declared: &Declarations,
        outward: Option<&mut (dyn StatePublisher + 'static)>,
    ) {
        std::thread::scope(|scope| {
            let publisher = outward.and_then(|outward| {
                let body = || self.publish_states(&declared.outward_topics, outward);
                let named = std::thread::Builder::new().name("to the robot".to_owned());
                let spawned = named.spawn_scoped(scope, body);
                spawned
                    .inspect_err(|cause| warn!("nothing is published to the robot: {cause}"))
                    .ok()
            });
            self.write_commands(&declared.commands);
            if let Some(publisher) = publisher {
                publisher.thread().unpark();
            }
        });
    }

    /// Publishes the agent's state when due, until the loop closes the command cell.
    fn publish_states(
        &self,
        outward_topics: &[(PublishedTopic, Writer)],
        outward: &mut dyn StatePublisher,
    ) {
        while !self.command_cell.is_closed() {
            let (now, wall_ns) = (self.clock.monotonic(), self.clock.host_wall_ns());
            outward.step(now, wall_ns, &mut |topic, bytes| {
                let writer = outward_topics.iter().find(|(known, _)| *known == topic);
                if let Some(Err(cause)) = writer.map(|(_, writer)| writer.put(bytes, wall_ns)) {
                    debug!("cannot publish {topic:?}: {cause}");
                }
            });
            std::thread::park_timeout(CHECK_EVERY);
        }
    }

    /// Writes each command once, and zero after [`COMMAND_SILENCE_MAX`] without a command.
    fn write_commands(&self, writer: &Writer) {
        let (mut number, mut written_at) = (0, self.clock.monotonic());
        let mut bytes = Vec::new();
        loop {
            let is_closed = self.command_cell.is_closed();
            let now = self.clock.monotonic();
            let newer = self.command_cell.newer_than(number);
            let is_silent = now.saturating_sub(written_at) >= COMMAND_SILENCE_MAX;
            if is_closed || newer.is_some() || is_silent {
                let command = match newer {
                    Some((newest, command)) if !is_closed => {
                        number = newest;
                        command
                    }
                    _ => WheelSpeeds::default(),
                };
                written_at = now;
                let wall_ns = self.clock.host_wall_ns();
                command::write(command, wall_ns, &self.settings.command, &mut bytes);
                self.command_watch.wrote(&bytes);
                if let Err(cause) = writer.put(&bytes, wall_ns) {
                    debug!("a command was not written: {cause}");
                }
            }
            if is_closed {
                return;
            }
            std::thread::park_timeout(COMMAND_SILENCE_MAX);
        }
    }
}

fn declare_token(session: &zenoh::Session, token: String) -> Result<LivelinessToken, LinkError> {
    let declaring = session.liveliness().declare_token(token);
    declaring.wait().map_err(zenoh_failed("announce the node"))
}

/// Passes a sample's key, attachment and payload to `take`.
fn deliver(sample: &zenoh::sample::Sample, take: impl FnOnce(&str, Option<&[u8]>, &[u8])) {
    let attachment = sample.attachment().map(small);
    let payload = sample.payload();
    // A payload above the limit is not assembled.
    let bytes = if payload.len() > PAYLOAD_BYTES_MAX {
        std::borrow::Cow::Borrowed(&[] as &[u8])
    } else {
        payload.to_bytes()
    };
    take(sample.key_expr().as_str(), attachment.as_deref(), &bytes);
}

/// Returns an attachment of the size that ROS uses; one of another size is returned empty.
fn small(attachment: &zenoh::bytes::ZBytes) -> std::borrow::Cow<'_, [u8]> {
    if attachment.len() == rmw::ATTACHMENT_BYTES {
        attachment.to_bytes()
    } else {
        std::borrow::Cow::Borrowed(&[])
    }
}

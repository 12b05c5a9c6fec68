//! Damaged payloads on every key that a robot may write, answer or announce.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::time::Instant;
use tread_agent::membership::Membership;
use tread_api::access::{Act, ROBOT_KEYS};
use tread_api::ids::BootId;
use tread_tests::damage::damage;
use tread_tests::light_robot::open_secure_session;
use tread_tests::random::Random;
use zenoh::handlers::FifoChannel;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait as _};

use super::Sent;

/// Messages of one session.
const MESSAGES: usize = 500;
/// Rest after a session that did not open.
const REST: Duration = Duration::from_millis(500);
/// Longest wait for a session.
const OPEN_MAX: Duration = Duration::from_secs(10);
/// Longest wait for an answer that nobody reads.
const QUESTION_TIMEOUT: Duration = Duration::from_millis(500);

/// Payloads as a good robot sends them.
pub(super) struct Templates {
    pub(super) state: Vec<u8>,
    pub(super) batch: Vec<u8>,
}

/// One robot that sends damaged payloads, by one session after the other.
pub(super) async fn attack(
    endpoint: String,
    membership: Membership,
    templates: Arc<Templates>,
    sent: Arc<Sent>,
    mut random: Random,
    until: Instant,
) {
    while Instant::now() < until {
        let opening = open_secure_session(&endpoint, &membership);
        let Ok(Ok((session, tunnel))) = tokio::time::timeout(OPEN_MAX, opening).await else {
            tokio::time::sleep(REST).await;
            continue;
        };
        sent.sessions.fetch_add(1, Ordering::Relaxed);
        let (templates, sent, membership) = (
            Arc::clone(&templates),
            Arc::clone(&sent),
            membership.clone(),
        );
        let mut chosen = Random::new(random.next_u64());
        // zenoh's calls block their thread.
        let sending = tokio::task::spawn_blocking(move || {
            // A link that ended takes the rest of its messages with it.
            let _ = send_all(&session, &membership, &templates, &sent, &mut chosen, until);
            drop(tunnel);
        });
        if sending.await.is_err() {
            return;
        }
    }
}

fn send_all(
    session: &Session,
    membership: &Membership,
    templates: &Templates,
    sent: &Sent,
    random: &mut Random,
    until: Instant,
) -> zenoh::Result<()> {
    // What the server asks of this robot is answered with what is damaged, too.
    let answers = ROBOT_KEYS.iter().find(|keys| keys.act == Act::Answer);
    let _answering = answers
        .map(|keys| {
            let expression = keys.expression(&membership.site, &membership.robot);
            let (batch, seed) = (templates.batch.clone(), random.next_u64());
            let answer = move |query: zenoh::query::Query| {
                let mut payload = batch.clone();
                damage(&mut payload, &mut Random::new(seed));
                let _ = query.reply(query.key_expr().clone(), payload).wait();
            };
            session
                .declare_queryable(expression)
                .callback(answer)
                .wait()
        })
        .transpose()?;
    let mut tokens = Vec::new();
    for _ in 0..MESSAGES {
        if Instant::now() >= until {
            return Ok(());
        }
        let keys = ROBOT_KEYS[random.index(ROBOT_KEYS.len())];
        let key = keys.expression(&membership.site, &membership.robot);
        let mut payload = match random.index(2) {
            0 => templates.state.clone(),
            _ => templates.batch.clone(),
        };
        damage(&mut payload, random);
        match keys.act {
            Act::Publish => {
                let put = session.put(key, payload);
                put.congestion_control(CongestionControl::Drop).wait()?;
            }
            Act::Ask => {
                let asked = session.get(key).payload(payload).timeout(QUESTION_TIMEOUT);
                drop(asked.with(FifoChannel::new(1)).wait()?);
            }
            Act::Announce => {
                let boot = BootId::from_uuid(uuid::Uuid::new_v4()).to_string();
                let odd = ["no-boot", "0", "%00", &boot][random.index(4)].to_owned();
                let token = session.liveliness().declare_token(key.replace('*', &odd));
                tokens.push(token.wait()?);
            }
            Act::Answer | Act::Listen => continue,
        }
        sent.payloads.fetch_add(1, Ordering::Relaxed);
    }
    Ok(())
}

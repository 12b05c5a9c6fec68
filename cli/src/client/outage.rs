//! Outages of the server during a command that polls it.

use std::time::Duration;

use tokio::time::Instant;

use super::ClientError;

/// Maximum duration of an outage that a command waits out: enough to restart a server, or for a
/// standby to take over.
const OUTAGE_MAX: Duration = Duration::from_mins(1);

/// Interval between two attempts during an outage.
const RETRY_INTERVAL: Duration = Duration::from_secs(2);

/// Whether the server answers a request that is repeated.
#[derive(Debug, Default)]
pub(crate) struct Outage {
    /// Whether the server has answered before. Until then its address may be wrong.
    has_answered: bool,
    since: Option<Instant>,
}

impl Outage {
    /// Returns the answer to a repeated request; `None` if it failed temporarily and is to be repeated.
    /// `notify` is called when an outage begins and when it is over.
    ///
    /// # Errors
    /// The request will not succeed if it is repeated, the server has never answered, or the outage
    /// lasts longer than a minute.
    pub(crate) fn bridge<T>(
        &mut self,
        answer: Result<T, ClientError>,
        notify: impl FnOnce(&str),
    ) -> Result<Option<T>, ClientError> {
        self.bridge_at(Instant::now(), answer, notify)
    }

    /// Returns the time of the outage so far; `None` if the server has answered the last request.
    pub(crate) fn duration(&self) -> Option<Duration> {
        self.since.map(|since| since.elapsed())
    }

    /// Returns the time until the request is to be repeated: `usual`, and longer during an outage.
    pub(crate) fn interval(&self, usual: Duration) -> Duration {
        self.since.map_or(usual, |_| RETRY_INTERVAL)
    }

    fn bridge_at<T>(
        &mut self,
        now: Instant,
        answer: Result<T, ClientError>,
        notify: impl FnOnce(&str),
    ) -> Result<Option<T>, ClientError> {
        let error = match answer {
            Ok(answer) => {
                self.has_answered = true;
                if self.since.take().is_some() {
                    notify("the server answers again");
                }
                return Ok(Some(answer));
            }
            Err(error) if error.is_temporary() && self.has_answered => error,
            Err(error) => return Err(error),
        };
        let Some(since) = self.since else {
            self.since = Some(now);
            notify(&format!(
                "{error}; trying again for {} s",
                OUTAGE_MAX.as_secs()
            ));
            return Ok(None);
        };
        if now.duration_since(since) < OUTAGE_MAX {
            Ok(None)
        } else {
            Err(error)
        }
    }
}

#[cfg(test)]
mod tests {
    use tread_api::problem::ProblemType;

    use super::*;

    fn unavailable() -> Result<(), ClientError> {
        Err(ClientError::refused(ProblemType::Unavailable, 503))
    }

    #[test]
    fn a_short_outage_is_bridged_and_reported_once() {
        let mut now = Instant::now();
        let mut outage = Outage::default();
        let mut notes = Vec::new();
        for answer in [Ok(()), unavailable(), unavailable(), Ok(()), unavailable()] {
            let is_answered = answer.is_ok();
            let bridged = outage.bridge_at(now, answer, |note| notes.push(note.to_owned()));
            assert_eq!(bridged.unwrap().is_some(), is_answered);
            now += OUTAGE_MAX / 3;
        }
        assert_eq!(notes.len(), 3, "{notes:?}");
        assert!(notes[0].ends_with("trying again for 60 s"), "{notes:?}");
        assert_eq!(notes[1], "the server answers again");
    }

    #[test]
    fn a_long_outage_is_an_error() {
        let begin = Instant::now();
        let mut outage = Outage::default();
        outage.bridge_at(begin, Ok(()), |_| ()).unwrap();
        let first = outage.bridge_at(begin, unavailable(), |_| ());
        assert!(first.unwrap().is_none());
        let last = outage.bridge_at(begin + OUTAGE_MAX, unavailable(), |_| ());
        last.unwrap_err();
    }

    #[test]
    fn what_will_not_succeed_later_is_an_error_at_once() {
        let refusals = [
            (ProblemType::Unauthenticated, 401),
            (ProblemType::UnknownMission, 404),
            (ProblemType::RobotUnreachable, 503),
        ];
        for (kind, status) in refusals {
            let mut outage = Outage::default();
            outage.bridge(Ok(()), |_| ()).unwrap();
            let bridged = outage.bridge(Err::<(), _>(ClientError::refused(kind, status)), |_| ());
            bridged.expect_err(kind.title());
        }
    }

    #[test]
    fn a_server_that_has_never_answered_is_an_error_at_once() {
        let first = Outage::default().bridge(unavailable(), |_| ());
        first.unwrap_err();
    }
}

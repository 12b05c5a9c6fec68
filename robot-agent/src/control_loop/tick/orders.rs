//! What the rest of the agent asks for: missions are begun, held, replaced, followed and ended.

use std::time::Duration;

use tread_api::ids::MissionId;
use tread_control::gate::GateCause;
use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;

use super::LoopCore;
use crate::control_loop::active::{Active, Hold, News, progress_of};
use crate::control_loop::channels::{COMMANDS_MAX, EndReason, Fault, Job, LoopCommand, LoopEvent};
use crate::control_loop::driven::TickRecord;
use crate::control_loop::segments::Moment;

/// Longest that a mission is held for a revision that does not come.
const REPLACEMENT_MAX: Duration = Duration::from_secs(10);

impl LoopCore {
    pub(super) fn take_commands(&mut self, now: Moment, stop: bool) {
        // Bounded: the channel holds a few, and whoever refills it waits for the network.
        for _ in 0..COMMANDS_MAX {
            let Ok(command) = self.ends.commands.try_recv() else {
                return;
            };
            if let Some(notes) = &mut self.notes {
                notes.command(self.ticks + 1, &command);
            }
            match command {
                LoopCommand::Start(job) => self.begin(now, job, stop),
                LoopCommand::Cancel(mission) => {
                    if let Some(active) = self.of(mission) {
                        active.stop(EndReason::Cancelled);
                    }
                }
                LoopCommand::Hold(mission, hold) => {
                    if let Some(active) = self.of(mission) {
                        active.hold(hold, true);
                        if hold == Hold::Replacement {
                            self.replacement_until = Some(now.monotonic + REPLACEMENT_MAX);
                        }
                    }
                }
                LoopCommand::Release(mission, hold) => {
                    if let Some(active) = self.of(mission) {
                        active.hold(hold, false);
                    }
                }
                LoopCommand::Replace(job) => match self.of(job.mission) {
                    Some(active) => {
                        // The room of one revision that is replaced before it was driven.
                        if let Some(unused) = active.replace_at_rest(job) {
                            self.outgoing.send(LoopEvent::CameTooLate(unused));
                        }
                        self.replacement_until = None;
                    }
                    None => self.outgoing.send(LoopEvent::CameTooLate(job)),
                },
                LoopCommand::Site(site) => {
                    self.cutter.abandon(&mut self.estimator);
                    self.estimate = self.estimator.estimate();
                    if let Some(old) = self.site.replace(site) {
                        self.outgoing.send(LoopEvent::Retired(old));
                    }
                }
            }
        }
    }

    /// The active mission, if it is this one.
    fn of(&mut self, mission: MissionId) -> Option<&mut Active> {
        self.active
            .as_mut()
            .filter(|active| active.job.mission == mission)
    }

    fn begin(&mut self, now: Moment, mut job: Box<Job>, stop: bool) {
        let progress = progress_of(&job);
        let refusal = if stop {
            Some(EndReason::AgentStopped)
        } else if self.active.is_some() {
            Some(EndReason::AnotherInHand)
        } else if job.start_by.is_some_and(|latest| now.monotonic > latest) {
            Some(EndReason::TooLate)
        } else {
            None
        };
        if let Some(reason) = refusal {
            self.outgoing.send(LoopEvent::Ended {
                at: now.wall,
                reason,
                progress,
                job,
            });
            return;
        }
        self.surface.begin_mission();
        if let Some(knowledge) = self.ground(&job.prior).told {
            job.follower.warm_start(knowledge);
        }
        self.active = Some(Active::new(job));
    }

    /// The wheel speeds that the mission wants; none without one.
    pub(super) fn follow(
        &mut self,
        now: Moment,
        fault: Option<Fault>,
        dt_s: f64,
    ) -> Option<WheelSpeeds> {
        let active = self.active.as_ref()?;
        let ground = self.ground(active.prior());
        let knowledge = ground.told;
        let measured = self.measured(now.monotonic);
        self.known = ground;
        let active = self.active.as_mut()?;
        if active.is_at_rest_for_replacement() {
            let old = active.replace(knowledge);
            let (at, progress) = (now.wall, active.progress);
            if let Some(old) = old {
                self.outgoing
                    .send(LoopEvent::Replaced { at, progress, old });
            }
        }
        let active = self.active.as_mut()?;
        let step = active.step(&measured, knowledge, &self.model, self.command, dt_s);
        if step.theta_loop.is_finite() {
            self.theta_loop = Some(step.theta_loop);
        }
        let (at, progress) = (now.wall, active.progress);
        match step.news {
            Some(News::Paused) => {
                let paused_for = active.paused_for(now.monotonic);
                let since = paused_for.and_then(|lasting| at.checked_sub(lasting).ok());
                self.outgoing.send(LoopEvent::Paused {
                    at,
                    since,
                    progress,
                });
            }
            Some(News::Resumed) => self.outgoing.send(LoopEvent::Resumed { at, progress }),
            None => {}
        }
        if let Some(reason) = step.end {
            self.end_mission(now, reason);
            return None;
        }
        // The gate would brake anyway; a follower that hears of it does not wind up meanwhile. A base
        // that is heard again after a silence comes to rest first.
        let is_heard = fault.is_none() && self.base_silent_at.is_none();
        is_heard.then_some(step.wanted)
    }

    pub(super) fn end_mission(&mut self, now: Moment, reason: EndReason) {
        if let Some(active) = self.active.take() {
            if !active.has_started {
                self.outgoing.send(LoopEvent::Started {
                    at: now.wall,
                    progress: active.progress,
                });
            }
            let progress = active.progress;
            let (job, next) = active.into_jobs();
            if let Some(next) = next {
                self.outgoing.send(LoopEvent::CameTooLate(next));
            }
            self.outgoing.send(LoopEvent::Ended {
                at: now.wall,
                reason,
                progress,
                job,
            });
        }
    }

    /// The first tick of a mission has given its first wheel command by now.
    pub(super) fn report_start(&mut self, now: Moment) {
        let Some(active) = self.active.as_mut().filter(|active| !active.has_started) else {
            return;
        };
        active.has_started = true;
        let progress = active.progress;
        self.outgoing.send(LoopEvent::Started {
            at: now.wall,
            progress,
        });
    }

    pub(super) fn record(&mut self, dt_s: f64, ground_changed: bool, gate: Option<GateCause>) {
        let Some(active) = &mut self.active else {
            return;
        };
        let speed_m_s = self.localisation.twist().linear_m_s.abs();
        let measured = self.estimate.theta;
        // While something cuts the command, errors say nothing on the ground.
        let may_learn = self.findings.consequence().is_none();
        active.hold_adaptation(
            !may_learn || gate.is_some_and(|cause| cause > GateCause::Acceleration),
        );
        active.record(TickRecord {
            dt_s,
            at: self.localisation.pose().map(Pose::point),
            driven_m: speed_m_s * dt_s,
            cross_track_m: None,
            is_saturated: false,
            is_paused: false,
            slips: self.slips || ground_changed,
            gate,
            theta_loop: self.theta_loop,
            theta_measured: measured.map(|theta| (theta.theta, theta.std_dev)),
            ground: self.known,
        });
    }
}

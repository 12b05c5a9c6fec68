//! What is printed: a report for people, or one JSON object.

use serde_json::{Value, json};
use tread_agent::drive::ros2::refusal::Source;
use tread_lab::logs::analysis::{Analysis, Verdict};
use tread_lab::logs::mapping::Mapping;
use tread_lab::logs::recording::Recording;
use tread_lab::report::{checks_json, checks_markdown};

fn name(source: Source) -> &'static str {
    match source {
        Source::Odometry => "odometry",
        Source::Imu => "imu",
        Source::Joints => "wheels",
        Source::Pose => "pose",
        Source::Battery => "battery",
    }
}

/// The result for programs.
pub(crate) fn json(recording: &Recording, mapping: &Mapping, analysis: &Analysis) -> Value {
    let files: Vec<String> = recording
        .files()
        .map(|file| file.display().to_string())
        .collect();
    let joints = mapping.settings.joints.as_ref();
    let clocks = analysis
        .clocks
        .iter()
        .map(|(source, clock)| (name(*source), *clock));
    let clocks: serde_json::Map<String, Value> = clocks
        .map(|(source, clock)| (source.to_owned(), json!(clock)))
        .collect();
    let refused: Vec<Value> = analysis
        .refusals
        .iter()
        .map(|(source, refusal, count)| {
            json!({ "topic": name(source), "reason": refusal.text(), "count": count })
        })
        .collect();
    json!({
        "files": files,
        "torn": analysis.torn,
        "topics": {
            "wheels": mapping.joints,
            "imu": mapping.imu,
            "odometry": mapping.odometry,
            "pose": mapping.pose.as_ref().map(|(topic, _)| topic),
        },
        "joints": joints.map(|joints| json!({
            "left": joints.left.names, "right": joints.right.names,
        })),
        "notices": mapping.notices,
        "clocks": clocks,
        "refused": refused,
        "interpolated": analysis.interpolated,
        "parts": analysis.parts,
        "short_drives": analysis.short_drives,
        "passes": analysis.passes,
        "overall": analysis.overall,
        "std_dev_ratios": analysis.std_dev_ratios(),
        "pairs": analysis.pairs,
        "chi_square_per_pair": analysis.mean_chi_square(),
        "chi_square_expected": 1.0,
        "effective_track": analysis.effective_track,
        "checks": checks_json(&analysis.checks),
    })
}

fn print_verdict(title: &str, verdict: &Verdict) {
    let motion = &verdict.motion;
    println!(
        "{title}: {:.1} to {:.1} s, moving {:.1} s, wheels every {:.0} ms, turning left {:.0} s and right {:.0} s, speed changing {:.0} s",
        verdict.from_s,
        verdict.to_s,
        motion.manoeuvres.moving_s,
        1.0e3 * motion.wheel_interval_s,
        motion.manoeuvres.left_s,
        motion.manoeuvres.right_s,
        motion.manoeuvres.accelerating_s,
    );
    if let Some(theta) = verdict.theta {
        println!(
            "  θ {:.4}, 95 % within {:.4} … {:.4}, σ {:.4} ({:.1} %), first after {:.0} s",
            theta.theta,
            theta.low_95,
            theta.high_95,
            theta.std_dev,
            100.0 * theta.std_dev / theta.theta,
            verdict.first_after_s.unwrap_or_default(),
        );
    }
    for reason in &verdict.abstains {
        println!("  abstains: {}; {}", reason.reason, reason.help);
    }
    if verdict.ground_changes > 0 {
        println!("  the ground changed {} times", verdict.ground_changes);
    }
    if verdict.contradicted_s > 0.0 {
        let subjects: Vec<&str> = verdict.contradicting.iter().copied().collect();
        println!(
            "  sensors contradicted each other for {:.1} s: {}",
            verdict.contradicted_s,
            subjects.join(", ")
        );
    }
}

/// The report for people.
pub(crate) fn text(mapping: &Mapping, analysis: &Analysis) {
    println!("topics: {}", mapping.topics().join(", "));
    if let Some(joints) = &mapping.settings.joints {
        let (left, right) = (joints.left.names.join(", "), joints.right.names.join(", "));
        println!("joints: left {left}; right {right}");
    }
    for notice in &mapping.notices {
        println!("note: {notice}");
    }
    for torn in &analysis.torn {
        println!("torn: {torn}; what comes before is read");
    }
    for (source, clock) in &analysis.clocks {
        println!("time of {}: {clock}", name(*source));
    }
    for (source, refusal, count) in analysis.refusals.iter() {
        println!("refused of {}: {count} {}", name(source), refusal.text());
    }
    if analysis.interpolated > 0 {
        println!("interpolated: {} wheel speeds", analysis.interpolated);
    }
    let (parts, short) = (analysis.parts, analysis.short_drives);
    println!(
        "{parts} parts, {} passes, {short} drives too short for one",
        analysis.passes.len()
    );
    for (index, pass) in analysis.passes.iter().enumerate() {
        print_verdict(&format!("pass {}", index + 1), pass);
    }
    print_verdict("all", &analysis.overall);
    if let Some((least, most)) = analysis.std_dev_ratios() {
        println!(
            "σ of the passes: {:.1} to {:.1} % of θ",
            100.0 * least,
            100.0 * most
        );
    }
    match analysis.mean_chi_square() {
        Some(mean) => println!(
            "χ² of {} pairs: {mean:.2} each, 1 is expected",
            analysis.pairs.len()
        ),
        None => println!("χ²: fewer than two passes have an estimate"),
    }
    match analysis.effective_track {
        Some(track) => println!(
            "W_eff/W {:.3}, 95 % within {:.3} … {:.3}, by {} s of steady turns to the left and {} s to the right",
            track.ratio, track.low_95, track.high_95, track.left_bins, track.right_bins
        ),
        None => println!("W_eff/W: fewer than five seconds of steady turns"),
    }
    print!("\n{}", checks_markdown(&analysis.checks));
}

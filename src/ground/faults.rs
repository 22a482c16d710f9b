//! The list of what an attacker, a bad line or a wrong clock can do to ground and aircraft, and the tests
//! that show what becomes of each: refused, counted, harmless. Whoever takes a test away finds it here.

use std::path::Path;

/// A file of the repository and a test in it.
type Proof = (&'static str, &'static str);

const SIGNING: &str = "mav/src/signing.rs";
const DOOR: &str = "src/ground/attackers.rs";
const DATAGRAMS: &str = "src/deliver/datagram/tests.rs";
const STORE: &str = "src/ground/store/tests.rs";

/// MAVLink: who is heard.
const MAVLINK: &[(&str, &[Proof])] = &[
    (
        "an unsigned frame while signing is required",
        &[(SIGNING, "only_allowed_messages_pass_unsigned")],
    ),
    (
        "a wrong signature",
        &[(SIGNING, "another_key_and_a_changed_byte_are_refused")],
    ),
    (
        "a signed frame again over the same link",
        &[(
            SIGNING,
            "a_signed_frame_passes_once_and_still_says_what_it_says",
        )],
    ),
    (
        "a recording played after our restart",
        &[(
            SIGNING,
            "what_was_recorded_before_a_restart_is_refused_after_it_whatever_the_clock_says",
        )],
    ),
    (
        "a recording played while our clock says 1970",
        &[
            (
                SIGNING,
                "what_was_recorded_before_a_restart_is_refused_after_it_whatever_the_clock_says",
            ),
            (
                SIGNING,
                "our_own_time_goes_on_after_a_restart_with_an_unset_clock",
            ),
        ],
    ),
    (
        "a good signature from the far future",
        &[(SIGNING, "a_peer_from_the_future_is_quarantined_alone")],
    ),
    (
        "the autopilot's address in a stranger's frames",
        &[
            (SIGNING, "another_key_and_a_changed_byte_are_refused"),
            (
                "mav/src/link.rs",
                "a_listening_udp_port_answers_whom_it_accepted_and_nobody_else",
            ),
        ],
    ),
    (
        "a second autopilot",
        &[(
            "tests/pymavlink.rs",
            "another_vehicle_than_the_missions_is_counted_and_never_spoken_to",
        )],
    ),
];

/// The line and the ground station.
const GROUND: &[(&str, &[Proof])] = &[
    (
        "no line for seconds or minutes",
        &[(
            DATAGRAMS,
            "after_ten_minutes_of_silence_everything_goes_within_a_second",
        )],
    ),
    (
        "loss, reordering, repetition",
        &[
            (
                "src/deliver/contract.rs",
                "datagrams_keep_to_the_contract_although_a_third_is_lost",
            ),
            (
                STORE,
                "a_repeated_delivery_is_acknowledged_and_changes_nothing",
            ),
        ],
    ),
    (
        "a narrow line",
        &[
            (
                DATAGRAMS,
                "a_picture_takes_500_bytes_a_second_and_no_time_of_an_alarm",
            ),
            (
                "src/deliver/mavlink/tests.rs",
                "frames_keep_their_distance_and_their_share_of_the_link",
            ),
        ],
    ),
    (
        "a ground station that acknowledges and crashes",
        &[
            (
                "src/ground/tests.rs",
                "an_alarm_that_was_acknowledged_is_served_and_outlives_a_restart",
            ),
            (STORE, "a_restart_keeps_everything_and_goes_on_counting"),
        ],
    ),
    (
        "a client that never reads",
        &[(
            DOOR,
            "who_never_reads_his_stream_is_shown_out_and_costs_nobody_else",
        )],
    ),
    (
        "a crowd of clients",
        &[(DOOR, "who_dawdles_is_shown_out_and_a_crowd_is_told_so")],
    ),
    (
        "one byte a second",
        &[(DOOR, "who_dawdles_is_shown_out_and_a_crowd_is_told_so")],
    ),
    (
        "a body of 1 GB, a head of 40 kB",
        &[(
            DOOR,
            "bodies_paths_headers_and_foreign_pages_are_refused_and_counted",
        )],
    ),
    (
        "nested JSON, a compressed bomb",
        &[(
            DOOR,
            "bodies_paths_headers_and_foreign_pages_are_refused_and_counted",
        )],
    ),
    (
        "no UTF-8, no JSON, no alarm",
        &[
            (
                DOOR,
                "bodies_paths_headers_and_foreign_pages_are_refused_and_counted",
            ),
            (
                "src/ground/tests.rs",
                "what_is_no_alarm_is_refused_with_the_reason_and_not_kept",
            ),
        ],
    ),
    (
        "no token, a wrong one, another's; an expired or a stranger's certificate",
        &[
            (
                DOOR,
                "tokens_let_each_role_do_its_own_and_guessing_is_cut_short",
            ),
            (
                DOOR,
                "a_browser_signs_in_once_and_nobody_can_do_it_in_its_name",
            ),
            (
                DOOR,
                "over_tls_certificates_count_and_old_versions_and_strangers_are_refused",
            ),
        ],
    ),
    (
        "an older TLS, or none",
        &[(
            DOOR,
            "over_tls_certificates_count_and_old_versions_and_strangers_are_refused",
        )],
    ),
    (
        "a forged receipt, or an old one again",
        &[
            (DATAGRAMS, "what_the_ground_did_not_sign_is_not_believed"),
            (DATAGRAMS, "answers_to_others_or_from_before_are_stray"),
            (
                "src/deliver/http.rs",
                "a_receipt_that_the_ground_did_not_sign_is_none",
            ),
        ],
    ),
    (
        "a path out of the folder",
        &[(
            DOOR,
            "bodies_paths_headers_and_foreign_pages_are_refused_and_counted",
        )],
    ),
    // Only the Foxglove view speaks WebSocket, and it is not at this door.
    (
        "a flood over a WebSocket",
        &[("src/ground/screens/config.rs", "every_problem_is_named")],
    ),
    (
        "a clock a day off",
        &[(
            DOOR,
            "a_clock_that_is_a_day_off_changes_neither_what_is_kept_nor_its_order",
        )],
    ),
    (
        "two stations that acknowledge one alarm",
        &[(
            STORE,
            "operators_are_recorded_once_and_told_to_the_aircraft",
        )],
    ),
    (
        "no ground station during the whole flight",
        &[
            (
                "src/deliver/outbox/tests.rs",
                "what_was_put_survives_a_restart_as_it_was",
            ),
            (
                "src/deliver/outbox/tests.rs",
                "delivered_alarms_are_pruned_and_waiting_ones_are_not",
            ),
        ],
    ),
];

#[test]
fn each_fault_of_the_list_has_its_test() {
    assert_eq!((MAVLINK.len(), GROUND.len()), (8, 18));
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for (fault, proofs) in MAVLINK.iter().chain(GROUND) {
        assert!(!proofs.is_empty(), "{fault}");
        for (file, test) in *proofs {
            let text = std::fs::read_to_string(root.join(file)).unwrap();
            // A function of no arguments, or one of the checks that run over each store.
            let is_there = text.contains(&format!("fn {test}("));
            assert!(is_there, "{fault}: there is no {test} in {file}");
        }
    }
}

"""./run with groups that end in every way."""

import os
import shutil
import signal
import unittest
from pathlib import Path

from support import SOURCE, STUBBORN, GroupTest

from launcher import run_folder

LEARN = ("--rig", "arm2")


class LearningEnds(GroupTest):
    def test_a_run_ends_with_what_follows_it_and_leaves_nothing(self):
        run = self.start(*LEARN)
        group = self.group()
        self.wait_for(lambda: (self.current / "camera.log").exists(), "a log of the camera")
        (self.current / "learned").touch()
        self.assertEqual(self.wait_for_end(run), 0)
        self.assertIn("learned", self.words())
        self.assert_nothing_is_left(group)

    def test_a_kept_group_goes_on_and_is_stopped(self):
        run = self.start(*LEARN, "--keep")
        (self.current / "learned").touch()
        self.assertEqual(self.wait_for_end(run), 0)
        self.assertIn("The group keeps running", self.words())
        group = self.group()
        self.assertEqual(self.run_to_end("exec", "sh", "-c", "echo $LCM_DEFAULT_URL")[0], "udpm://239.255.76.67:7667?ttl=0\n")
        self.assertIn("a group runs already", self.run_to_end(*LEARN)[0])
        ignored = self.run_to_end("exec", "sed", "-n", "s/^SigIgn:[[:space:]]*//p", "/proc/self/status")
        self.assertEqual(ignored, ("0000000000000000\n", 0), "a tool in a pipe ends with its reader")
        for arguments in ((), ("--out", "page.html"), (str(self.current),)):
            self.assertIn("--growing", self.run_to_end("report", *arguments)[0])
        self.assertNotIn("--growing", self.run_to_end("report", str(self.folder))[0])
        self.assertEqual(self.run_to_end("stop"), ("stopped\n", 0))
        self.assert_nothing_is_left(group)
        self.assertEqual(self.run_to_end("stop"), ("no group runs\n", 0))
        self.assertNotIn("--growing", self.run_to_end("report")[0])

    def test_the_group_ends_with_its_run_that_is_killed(self):
        run = self.start(*LEARN)
        group = self.group()
        run.kill()
        self.wait_for(group.has_ended, "an end of the group")

    def test_an_interrupted_run_sums_up_and_ends_its_group(self):
        run = self.start(*LEARN)
        group = self.group()
        self.wait_for(lambda: "watching" in self.words(), "somebody who watches")
        run.send_signal(signal.SIGTERM)
        self.assertEqual(self.wait_for_end(run), 1)
        self.assertIn("interrupted", self.words())
        self.assert_nothing_is_left(group)


class CalibrationErrors(GroupTest):
    def words_of_the_simulation(self, *arguments):
        for name in ("robot_simulator", "camera"):
            self.write_program(name, '#!/bin/sh\necho "$@"\nwhile :; do sleep 0.1; done\n')
        run = self.start(*LEARN, *arguments)
        logs = [(self.current / f"{name}.log").read_text() for name in ("robot_simulator", "camera")]
        (self.current / "learned").touch()
        self.assertEqual(self.wait_for_end(run), 0)
        return logs

    def noise(self):
        return (self.current / "config" / "noise.yaml").read_text()

    def test_are_there_unless_the_robot_is_to_be_ideal(self):
        for log in self.words_of_the_simulation():
            self.assertNotIn("--ideal", log)
        self.assertIn("tag_position_m: 0.0005", self.noise())
        for log in self.words_of_the_simulation("--ideal"):
            self.assertIn("--ideal", log)
        self.assertIn("tag_position_m: 0\n", self.noise())

    def test_are_not_those_of_a_replay(self):
        self.assertIn("--ideal has no meaning with --replay", self.run_to_end("--replay", "log", "--ideal")[0])


class TheRefiner(GroupTest):
    def words_of_a_run(self, enabled):
        rig = self.folder / f"rig {enabled}"
        shutil.copytree(SOURCE / "config" / "arm2", rig)
        file = rig / "refiner.yaml"
        file.write_text(file.read_text().replace("enabled: false", f"enabled: {enabled}"))
        run = self.start("--rig", str(rig))
        (self.current / "learned").touch()
        self.assertEqual(self.wait_for_end(run), 0)
        return self.words()

    def test_runs_where_the_rig_enables_it(self):
        for name in ("refiner", "model_monitor"):
            self.write_program(name, '#!/bin/sh\necho "$@"\nwhile :; do sleep 0.1; done\n')
        self.words_of_a_run("true")
        self.assertIn("--refined", (self.current / "refiner.log").read_text())
        self.assertIn(f"--refiner {self.current.resolve()}/config/refiner.yaml", (self.current / "model_monitor.log").read_text())

    def test_is_missed_only_where_the_rig_enables_it(self):
        self.write_program("model_monitor", '#!/bin/sh\necho "$@"\nwhile :; do sleep 0.1; done\n')
        self.assertIn("built without Ceres", self.words_of_a_run("true"))
        self.assertNotIn("--refiner", (self.current / "model_monitor.log").read_text())
        self.assertNotIn("Ceres", self.words_of_a_run("false"))
        self.assertNotIn("--refiner", (self.current / "model_monitor.log").read_text())


class OthersEndTheGroup(GroupTest):
    def test_a_run_says_at_once_that_it_was_stopped_from_elsewhere(self):
        run = self.start(*LEARN)
        group = self.group()
        self.assertEqual(self.run_to_end("stop"), ("stopped\n", 0))
        self.assertEqual(self.wait_for_end(run), 1)
        self.assertIn("the group was stopped from elsewhere (./run stop)", self.words())
        self.assertNotIn("keeps running", self.words())
        self.assert_nothing_is_left(group)

    def test_stop_waits_until_the_run_is_summed_up(self):
        self.start(*LEARN, FAKE_SUMMARY_S="2")
        self.run_to_end("stop")
        self.assertFalse(run_folder.is_locked(self.logs))

    def test_a_run_that_keeps_its_group_says_so_too(self):
        run = self.start(*LEARN, "--keep")
        self.run_to_end("stop")
        self.assertEqual(self.wait_for_end(run), 1)
        self.assertIn("stopped from elsewhere", self.words())
        self.assertNotIn("keeps running", self.words())

    def test_a_run_says_at_once_that_its_group_died(self):
        for keep in ((), ("--keep",)):
            with self.subTest(keep=keep):
                run = self.start(*LEARN, *keep)
                group = self.group()
                os.kill(self.process_called("supervisord"), signal.SIGKILL)
                self.assertEqual(self.wait_for_end(run), 1)
                self.assertIn("the process group ended by SIGKILL", self.words())
                self.assertNotIn("keeps running", self.words())
                self.assert_nothing_is_left(group)

    def test_a_run_whose_folder_is_deleted_says_so_and_ends_its_group(self):
        for keep in ((), ("--keep",)):
            with self.subTest(keep=keep):
                run = self.start(*LEARN, *keep)
                group = self.group()
                self.delete(self.current.resolve())
                self.assertEqual(self.wait_for_end(run), 1)
                self.assertIn("the folder of this run was deleted", self.words())
                self.assertNotIn("keeps running", self.words())
                self.assert_nothing_is_left(group)

    def test_a_kept_group_is_found_and_stopped_when_its_folder_is_gone(self):
        for gone in ("current", "logs"):
            with self.subTest(gone=gone):
                run = self.start(*LEARN, "--keep")
                (self.current / "learned").touch()
                self.wait_for_end(run)
                group = self.group()
                self.assertGreater(len(group.pids()), 10)
                self.delete(self.current.resolve() if gone == "current" else self.logs)
                out, code = self.run_to_end(*LEARN)
                self.assertIn(f"a group runs already, from {group.run}", out)
                self.assertEqual(code, 1)
                self.assertEqual(self.run_to_end("stop"), ("stopped\n", 0))
                self.assert_nothing_is_left(group)

    def test_a_frozen_supervisord_is_stopped_within_bounds(self):
        self.write_program("camera", STUBBORN)
        for network in ("private", "host"):
            with self.subTest(network=network):
                run = self.start(*LEARN, "--keep", FAKE_NETWORK=network)
                (self.current / "learned").touch()
                self.wait_for_end(run)
                group = self.group()
                os.kill(self.process_called("supervisord"), signal.SIGSTOP)
                os.kill(self.process_called("observer"), signal.SIGSTOP)
                self.assertEqual(self.run_to_end("stop"), ("stopped\n", 0))
                self.assert_nothing_is_left(group)

    def test_what_a_killed_supervisord_leaves_is_stopped(self):
        self.write_program("camera", STUBBORN)
        run = self.start(*LEARN, "--keep", FAKE_NETWORK="host")
        (self.current / "learned").touch()
        self.wait_for_end(run)
        group = self.group()
        os.kill(self.process_called("supervisord"), signal.SIGKILL)
        self.wait_for(lambda: len(group.pids()) <= 2, "an end of the others")
        self.assertEqual(self.run_to_end("stop"), ("stopped\n", 0))
        self.assert_nothing_is_left(group)


class WhoFollowsTheGroup(GroupTest):
    def kill_watch(self, times):
        for count in range(1, times + 1):
            self.wait_for(lambda: self.words().count("watching") == count, f"watch number {count}")
            for pid in map(int, filter(str.isdigit, os.listdir("/proc"))):
                try:
                    words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
                except OSError:
                    continue
                if b"watch" in words and str(self.logs).encode() in b" ".join(words):
                    os.kill(pid, signal.SIGSEGV)

    def test_is_started_again_when_it_crashes(self):
        run = self.start(*LEARN)
        self.kill_watch(2)
        self.wait_for(lambda: self.words().count("watching") == 3, "a third one")
        (self.current / "learned").touch()
        self.assertEqual(self.wait_for_end(run), 0)
        self.assertEqual(self.words().count("was ended by SIGSEGV; it is started again"), 2)

    def test_is_not_started_for_ever(self):
        console = (self.bin / "bodyschema").read_text()
        self.write_program("bodyschema", console.replace('print("watching"', 'os.kill(os.getpid(), 11), print("watching"'))
        run = self.start(*LEARN)
        group = self.group()
        self.assertEqual(self.wait_for_end(run), 1)
        self.assertEqual(self.words().count("it is started again"), 10)
        self.assert_nothing_is_left(group)


class StrangePaths(GroupTest):
    logs_name = "100% of \"it's\" #1 ; $HOME/logs"

    def test_a_group_runs_in_a_folder_of_any_name(self):
        run = self.start(*LEARN)
        log = self.current / "camera.log"
        self.wait_for(lambda: log.exists() and "line 2" in log.read_text(), "a log of the camera")
        self.wait_for(lambda: (self.current / "run.lcmlog.00").exists(), "a log of the bus")
        (self.current / "learned").touch()
        self.assertEqual(self.wait_for_end(run), 0)


class HelpNeverActs(GroupTest):
    def test_neither_of_our_words_nor_of_the_consoles(self):
        run = self.start(*LEARN, "--keep")
        (self.current / "learned").touch()
        self.wait_for_end(run)
        runs = sorted(self.logs.iterdir())
        for words in ("stop", "exec", "spy", "driver-test", "test", "experiment", "experiments", "status", "report", "rig"):
            for option in ("--help", "-h"):
                out, code = self.run_to_end(words, option)
                self.assertEqual(code, 0, words)
                self.assertIn(words, out)
        for word in ("halt", "target", "follow", "where", "hold", "release", "resume", "fault"):
            out, code = self.run_to_end(word, "--help")
            self.assertEqual((out, code), (f"{word} --help\n", 0))
        self.assertEqual(self.run_to_end("fault", "bend", "--help")[0], "fault bend --help\n")
        # The workspace that the group's controller keeps to.
        self.assertIn(f"follow path.csv --rig {self.current.resolve() / 'config'}\n", self.run_to_end("follow", "path.csv")[0])
        self.assertNotIn("--rig", self.run_to_end("hold")[0])
        self.run_to_end("--rig", "arm2", "--help")
        self.run_to_end("stop", "--now")
        self.assertFalse(self.group().has_ended())
        self.assertEqual(sorted(self.logs.iterdir()), runs)

    def test_the_version_is_that_of_the_console(self):
        self.assertEqual(self.run_to_end("--version"), ("bodyschema 1.2.3\n", 0))
        self.assertFalse(self.logs.exists())

    def test_words_that_are_not_there_are_refused(self):
        for words in ("stop all", "lern", "--sample 3", "--samples 0", "--seed x", "--speed 2", "--replay FILE --keep", "exec"):
            out, code = self.run_to_end(*words.split())
            self.assertEqual(code, 2, out)
        self.assertIn("did you mean 'learn'?", self.run_to_end("lern")[0])
        self.assertFalse(self.logs.exists())

    def test_status_of_a_tree_that_is_not_built_builds_nothing(self):
        (self.bin / "bodyschema").unlink()
        out, code = self.run_to_end("status")
        self.assertEqual((out, code), ("run: no group runs, and nothing is built yet; ./run does both\n", 1))


if __name__ == "__main__":
    unittest.main()

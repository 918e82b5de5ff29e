"""The launcher's parts alone."""

import os
import shutil
import socket
import subprocess
import tempfile
import threading
import unittest
from dataclasses import replace
from pathlib import Path
from unittest import mock

from support import SOURCE

from launcher import build, commands, group_file, packages, run_folder, supervisor, test_selection
from launcher.place import Place


class Folder(unittest.TestCase):
    def setUp(self):
        self.folder = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.folder)


class ABuild(Folder):
    def test_waits_for_another_of_the_same_tree(self):
        done = []

        def second():
            with build.alone(self.folder):
                done.append("second")

        with build.alone(self.folder):
            thread = threading.Thread(target=second)
            thread.start()
            thread.join(0.3)
            done.append("first")
        thread.join()
        self.assertEqual(done, ["first", "second"])


class ThePackageList(Folder):
    def test_tells_those_that_are_needed_from_those_that_are_not(self):
        file = self.folder / "packages.txt"
        file.write_text("# build\nninja-build\nlibceres-dev  # optional: bodyschema refine\ncmake  # not optional\n")
        self.assertEqual(packages.listed(file), ["ninja-build", "cmake"])
        self.assertEqual(packages.listed(file, optional=True), ["libceres-dev"])


class TheGroupFile(Folder):
    def test_leaves_out_what_the_rig_has_no_file_for(self):
        file = self.folder / "group.conf"
        file.write_text('# NAME COMMAND\n\nsimulator?  "$BIN/simulator" $FLAGS\ncontroller? "$BIN/controller"\nlog  logger -i "$RUN/log"\n')
        (self.folder / "controller.yaml").touch()
        self.assertEqual(
            group_file.processes(file, self.folder),
            {"controller": '"$BIN/controller"', "log": 'logger -i "$RUN/log"'},
        )
        self.assertEqual(group_file.speakers(self.folder, ["log", "controller"]), ["controller"])

    def test_leaves_out_what_the_rig_disables(self):
        file = self.folder / "group.conf"
        file.write_text("refiner? refines\n")
        for text, names in [
            ("enabled: false   # off\n", []),
            ("placements: true\nenabled: false\n", []),
            ("enabled: true\n", ["refiner"]),
            ("# enabled: false\nis_enabled: false\n", ["refiner"]),
        ]:
            (self.folder / "refiner.yaml").write_text(text)
            self.assertEqual(list(group_file.processes(file, self.folder)), names, text)

    def test_each_shipped_rig_has_a_group(self):
        for rig in ("arm2", "arm4", "arm6_ends", "arm7"):
            group = group_file.processes(SOURCE / "config" / "group.conf", SOURCE / "config" / rig)
            self.assertIn("robot_simulator", group)
            self.assertIn("log", group)


class ARecordedConfiguration(Folder):
    def test_names_the_files_in_which_a_rig_differs_from_it(self):
        rig = SOURCE / "config" / "arm4"
        recorded = self.folder / "config"
        shutil.copytree(rig, recorded)
        self.assertEqual(run_folder.differences(recorded, rig), [])
        run_folder.tell_ideal_noise(self.folder)
        self.assertEqual(run_folder.differences(recorded, rig), ["noise.yaml"])
        (recorded / "observer.yaml").unlink()
        self.assertEqual(run_folder.differences(recorded, rig), ["noise.yaml", "observer.yaml"])


class AProcess(Folder):
    def run_script(self, command, **variables):
        run = self.folder / "a $run's \"folder\""
        run.mkdir(exist_ok=True)
        script = self.folder / "script"
        script.write_text(supervisor.script("name", command))
        given = {f"BODYSCHEMA_{name}": value for name, value in variables.items()}
        code = subprocess.run(["sh", script], env=os.environ | given | {"BODYSCHEMA_RUN": str(run)}).returncode
        return code, (run / "name.log").read_text()

    def test_gets_paths_as_one_word_and_flags_as_several_or_none(self):
        command = 'printf "[%s]" "$RIG/x y" $FLAGS ${INITIAL:+--initial "$INITIAL"}'
        self.assertEqual(self.run_script(command, RIG="/a 'b", FLAGS="--seed 3"), (0, "[/a 'b/x y][--seed][3]"))
        self.assertTrue(self.run_script(command, RIG="/", FLAGS="", INITIAL="a b")[1].endswith("[//x y][--initial][a b]"))

    def test_says_in_its_log_that_its_program_is_missing(self):
        code, log = self.run_script('"$BIN/missing"', BIN="/nowhere")
        self.assertNotEqual(code, 0)
        self.assertIn("/nowhere/missing", log)


class ASocket(Folder):
    def setUp(self):
        super().setUp()
        self.path = self.folder / "supervisor.sock"
        self.listener = socket.socket(socket.AF_UNIX)
        self.addCleanup(self.listener.close)
        self.listener.bind(str(self.path))
        self.listener.listen()

    def test_of_another_process_than_the_groups_is_not_spoken_to(self):
        with self.assertRaises(supervisor.Stranger), supervisor.Supervisor(self.path, pids=[1]) as proxy:
            proxy.supervisor.shutdown()
        connection, _ = self.listener.accept()
        self.assertEqual(connection.recv(1), b"", "nothing was said")
        connection.close()

    @unittest.skipIf(os.getuid() != 0, "only root can be somebody else")
    def test_of_another_user_is_not_spoken_to(self):
        os.setegid(65534), os.seteuid(65534)
        try:
            self.listener.listen()
        finally:
            os.seteuid(0), os.setegid(0)
        with self.assertRaises(supervisor.Stranger), supervisor.Supervisor(self.path, pids=[os.getpid()]) as proxy:
            proxy.supervisor.shutdown()

    def test_that_is_ours_and_silent_ends_in_a_time_out(self):
        with self.assertRaises(TimeoutError), supervisor.Supervisor(self.path, pids=[os.getpid()]) as proxy:
            proxy.supervisor.shutdown()


class ThePrivateFolder(unittest.TestCase):
    def test_is_the_users_alone_and_short_enough_for_a_socket(self):
        for place in ("/tmp", "/tmp/" + "long" * 20, "/tmp/with space", "/tmp/with%percent"):
            os.makedirs(place, exist_ok=True)
            before, tempfile.tempdir = tempfile.tempdir, place
            try:
                folder = supervisor.private_folder()
            finally:
                tempfile.tempdir = before
            self.assertEqual(folder.stat().st_mode & 0o777, 0o700)
            self.assertLess(len(str(folder / supervisor.SOCKET) + ".1234567"), 108)
            self.assertRegex(str(folder), r"^[\w./-]*$")
            folder.rmdir()
            if place != "/tmp":
                os.rmdir(place)

    def test_of_a_killed_group_is_removed_by_the_next(self):
        folders = {name: supervisor.private_folder() for name in ("dead", "alive", "starting")}
        listeners = {name: socket.socket(socket.AF_UNIX) for name in folders}
        for name, listener in listeners.items():
            listener.bind(str(folders[name] / supervisor.SOCKET))
            if name == "alive":
                listener.listen()
            if name != "starting":
                os.utime(folders[name], (0, 0))
        supervisor.remove_dead_folders()
        self.assertEqual({name for name, folder in folders.items() if folder.exists()}, {"alive", "starting"})
        for name, listener in listeners.items():
            listener.close()
            shutil.rmtree(folders[name], ignore_errors=True)


class TheTestsThatAreSelected(Folder):
    """A build tree of two programs with tests, one of them built, and a script."""

    def setUp(self):
        super().setUp()
        self.place = Place(self.folder, self.folder / "build", self.folder / "logs")
        self.place.bin.mkdir(parents=True)
        (self.folder / "script.sh").write_text('"$build/bin/judge" and programs\n')
        (self.folder / "pose_test.cpp").write_text("TEST(Pose, IsComposed) {}\nTEST_P(EachPose, IsInverted) {}\n")
        (self.folder / "bus_test.cpp").write_text("TEST_F(Bus, IsHeard) {}\n")
        (self.folder / "judge.cpp").write_text("int main() {}\n")
        self.sources = {name: [self.folder / f"{name}.cpp"] for name in ("pose_test", "bus_test", "judge")}
        self.tests = [
            {"name": "Pose.IsComposed", "command": [str(self.place.bin / "pose_test"), "--gtest_filter=Pose.IsComposed"]},
            {"name": "bus_test_NOT_BUILT"},
            {"name": "whole_group", "command": [str(self.folder / "script.sh"), str(self.place.build)]},
            {"name": "alone", "command": ["python3", str(self.folder / "script.sh")]},
        ]

    def of(self, *arguments, listed=()):
        tests = [test for test in self.tests if test["name"] in listed]
        return test_selection.chosen(self.place, list(arguments), tests, self.sources, {"pose_test", "bus_test"})

    def test_want_all_targets_if_nothing_is_selected_or_known(self):
        self.assertIsNone(self.of())
        self.assertIsNone(self.of("-j", "2"))
        self.assertIsNone(self.of("-R", "NoSuchTest"))

    def test_want_their_own_program(self):
        self.assertEqual(self.of("-R", "Pose.IsC", listed=["Pose.IsComposed"]), ["pose_test"])

    def test_are_found_in_the_sources_before_they_are_built(self):
        self.assertEqual(self.of("-R", "Bus.IsHeard"), ["bus_test"])
        self.assertEqual(self.of("--tests-regex", "^EachPose.*Inverted"), ["pose_test"])
        self.assertEqual(self.of("-R", "Is"), ["bus_test", "pose_test"])

    def test_want_what_has_their_label(self):
        self.assertEqual(self.of("-L", "fast", listed=["bus_test_NOT_BUILT"]), ["bus_test"])

    def test_of_nothing_that_is_built_want_nothing(self):
        self.assertEqual(self.of("-R", "alone", listed=["alone"]), [])

    def test_know_the_command_of_a_program_that_is_not_built(self):
        text = 'add_test([=[kills]=] "/b/bin/kills" "--rig" "arm2")\nadd_test(hosts_test.2x0 "/s/hosts.sh" "/b")\nset_tests_properties(x)\n'
        expected = {"kills": ["/b/bin/kills", "--rig", "arm2"], "hosts_test.2x0": ["/s/hosts.sh", "/b"]}
        self.assertEqual(test_selection.commands_written([text]), expected)

    def test_know_the_sources_of_each_target_from_its_objects(self):
        command = "g++ -include /b/CMakeFiles/precompiled.dir/cmake_pch.hxx -o tests/x/CMakeFiles/pose_test.dir/pose_test.cpp.o -c /s/pose_test.cpp"
        entries = [{"file": "/s/pose_test.cpp", "command": command}]
        self.assertEqual(test_selection.sources_of_targets(entries), {"pose_test": [Path("/s/pose_test.cpp")]})

    def test_that_are_scripts_want_the_programs_and_what_they_name(self):
        self.assertEqual(self.of("-R", "whole", listed=["whole_group"]), ["judge", "programs"])

    def test_see_the_environment_of_a_console_that_run_did_not_start(self):
        with mock.patch.object(commands, "become") as become, mock.patch.dict(os.environ, BODYSCHEMA_COMMAND="./run"):
            become.side_effect = lambda _: self.assertNotIn("BODYSCHEMA_COMMAND", os.environ)
            self.addCleanup(os.chdir, os.getcwd())
            commands.test(replace(self.place, is_build_given=True), ["-R", "alone"])
            become.assert_called_once()

    def test_an_experiment_is_found_by_either_word(self):
        for function in commands.experiment, commands.experiments:
            with mock.patch.object(commands, "become") as become, mock.patch.object(commands, "build") as built:
                become.side_effect = SystemExit  # as another program
                self.addCleanup(os.chdir, os.getcwd())
                with self.assertRaises(SystemExit):
                    function(replace(self.place, source=SOURCE), ["control", "--seed", "2"])
            self.assertEqual(built.call_args.args[1:], ("control",))
            self.assertEqual(become.call_args.args[0][1:], ["--seed", "2"])

    def test_are_all_wanted_if_the_name_is_no_regular_expression_of_ours(self):
        self.assertIsNone(self.of("-R", "(["))


if __name__ == "__main__":
    unittest.main()

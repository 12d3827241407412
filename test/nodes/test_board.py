# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of what browsers are shown."""

from tap_ros.nodes.explorer.board import Board


def test_whoever_looks_gets_the_newest_of_each_kind_once():
    board = Board()
    board.put('camera', b'1')
    board.put('state', 'a')
    board.put('camera', b'2')
    number, contents = board.since(0)
    assert contents == {'state': 'a', 'camera': b'2'}
    assert board.since(number) == (number, {})
    board.put('state', 'b')
    assert board.since(number)[1] == {'state': 'b'}
    assert board.since(0)[1] == {'camera': b'2', 'state': 'b'}, 'who comes late gets all'


def test_what_did_not_change_is_not_told():
    board, told = Board(), []
    board.watch(lambda: told.append(1))
    board.put('state', 'a')
    board.put('state', 'a')
    assert len(told) == 1 and board.watched == 1


def test_whoever_leaves_is_told_no_more():
    board, told = Board(), []

    def tell():
        told.append(1)

    board.watch(tell)
    board.leave(tell)
    board.leave(tell)
    board.put('state', 'a')
    assert not told and board.watched == 0

from glob import glob

from setuptools import find_packages, setup

package_name = 'ps_head_driver'

setup(
    name=package_name,
    version='0.1.0',
    packages=find_packages(exclude=['test']),
    package_data={package_name: ['py.typed', 'data/*', 'templates/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        ('share/' + package_name + '/config', glob('config/*.yaml')),
        ('share/' + package_name + '/launch', glob('launch/*.launch.py')),
        ('share/' + package_name + '/urdf', glob('urdf/*')),
    ],
    install_requires=['setuptools'],
    zip_safe=True,
    maintainer='ps_head maintainers',
    maintainer_email='maintainers@ps-head.invalid',
    description='The head: kinematics, light model, link, cameras, fake hardware.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'head_driver = ps_head_driver.nodes.head_driver:main',
            'convergence_radius = ps_head_driver.nodes.convergence_radius:main',
            'camera_sequencer = ps_head_driver.nodes.camera_sequencer:main',
            'ps_cr = ps_head_driver.cli.ps_cr:main',
            'ps_urdf = ps_head_driver.cli.ps_urdf:main',
            'ps_head_emulator = ps_head_driver.fake.emulator_process:main',
        ],
    },
)
